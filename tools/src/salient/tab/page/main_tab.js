// The page of a tab: the live page on a drive of its own, and a bar for what only this one can do.

import { startPage } from "../../view/page/app.js";
import { OtherBranch } from "./branch.js";
import { readData } from "./data.js";
import { readLink } from "./link.js";
import { TabSource } from "./source_tab.js";

const FIRST_EVENTS = "events=0.02:speed_reference:rpm=300"; // of an address without a link: it turns at once
const BACK_S = [0.1, 1, 10];
const PACES = [["0.01", "1:100"], ["0.1", "1:10"], ["1", "real time"], ["2", "2 x"], ["5", "5 x"]];
const CONTROLLERS = ["salient", "paper", "traditional"];

function make(tag, properties = {}, ...children) {
    const made = Object.assign(document.createElement(tag), properties);
    made.append(...children);
    return made;
}

function select(id, text, list, chosen, onChange) {
    const made = make("select", { id });
    made.append(...list.map(([value, label]) => new Option(label, value, false, value === chosen)));
    made.addEventListener("change", () => onChange(made.value));
    return make("label", {}, `${text} `, made);
}

function tell(text, isBad) {
    const notice = document.getElementById("notice");
    notice.textContent = text;
    notice.hidden = text === "";
    notice.classList.toggle("bad", isBad);
}

function makeBar(page, source) {
    const { setting } = source;
    const begin = (changes) => {
        const { machine, options } = setting;
        const values = { machine, ...options, ...changes };
        location.hash = `${Object.entries(values).map(([name, value]) => `${name}=${encodeURIComponent(value)}`).join("&")}`
            + `&${FIRST_EVENTS}`;
    };
    const back = BACK_S.map((duration_s) => {
        const button = make("button", { type: "button", textContent: `−${duration_s} s`,
                                        title: `Go back ${duration_s} s; time stands still there` });
        button.addEventListener("click", () => {
            source.rewind(source.run.timeNs - duration_s * 1e9);
            if (!page.stopped) {
                page.stopTime();
            }
        });
        return button;
    });
    const link = make("button", { type: "button", id: "copy-link", textContent: "Copy link",
                                  title: "A link that repeats this run to the bit" });
    link.addEventListener("click", async () => {
        const hash = await source.link();
        history.replaceState(null, "", hash);
        await navigator.clipboard?.writeText(location.href).catch(() => {});
        tell("The address of this page is now the link to this run, up to this moment.", false);
    });
    const bar = make("p", { id: "tab-bar", className: "toolbar" },
        select("machine", "Machine", Object.keys(source.data.machines).map((name) => [name, name.replaceAll("_", " ")]),
               setting.machine, (machine) => begin({ machine })),
        select("controller", "Controller", CONTROLLERS.map((name) => [name, name]), setting.options.controller ?? "salient",
               (controller) => begin({ controller })),
        select("pace", "Pace", PACES, "1", (pace) => { source.pace = Number(pace); }),
        make("span", { role: "group", ariaLabel: "Go back" }, "Back ", ...back), link);
    bar.style.padding = ".35rem .9rem";
    document.querySelector("header").after(bar);
}

async function main() {
    let setting;
    const data = await readData(document.getElementById("tab-data").textContent);
    try {
        setting = await readLink(location.hash);
        if (setting.empty) {
            setting = { ...await readLink(FIRST_EVENTS), build: data.build };
        }
    } catch (error) {
        tell(error.message, true);
        return;
    }
    addEventListener("hashchange", () => location.reload());
    const source = new TabSource(data, setting);
    source.onSame = (timeNs, same, text) => tell(text, !same);
    const page = await startPage(source);
    if (page === null) {
        return;
    }
    const other = new OtherBranch(page);
    source.onRewound = (fromNs) => other.keep(fromNs);
    source.onEnd = () => page.stopped || page.stopTime();
    document.querySelector("#run-panel > .hint:last-child").textContent = "The drive is in this page: its time stands still "
        + "while the page is not seen. After going back, a change begins another branch; the abandoned one is dotted.";
    makeBar(page, source);
    if (setting.build !== undefined && setting.build !== data.build) {
        tell(`The link is of build ${setting.build}, this page is of build ${data.build}: its bits may be others.`, true);
    }
}

main();
