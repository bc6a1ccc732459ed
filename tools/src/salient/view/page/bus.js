// The traffic of the bus: load, and the messages by node with their cycle times.

import { breakable, element, make } from "./controls.js";

const percent = (part) => `${(100 * part).toFixed(1)} %`;

/** A row: name and identifier, frames, cycle, and the expected one or what is wrong. */
function rowOf(message) {
    const cycle = message.cycle_ms === null ? "–" : message.cycle_ms.toFixed(message.cycle_ms < 1000 ? 2 : 0);
    const expected = message.state || (message.expected_ms === null ? "–" : String(message.expected_ms));
    const span = message.longest_ms ? `${message.shortest_ms.toFixed(3)} to ${message.longest_ms.toFixed(3)} ms` : "";
    return make("tr", { className: message.state ? "changed" : "", title: span },
                make("th", { scope: "row" }, ...breakable(message.name), make("small", { textContent: ` ${message.id}` })),
                make("td", { textContent: message.frames }), make("td", { textContent: cycle }),
                make("td", { className: message.state ? "missing" : "", textContent: expected }));
}

function groupOf(title, messages) {
    return make("tbody", {}, make("tr", { className: "node" }, make("th", { colSpan: 4, scope: "rowgroup",
                                                                            textContent: title })),
                ...messages.map(rowOf));
}

/** traffic: of a notice; show(time_ns): shows the plots around a time. */
export function showTraffic(traffic, show) {
    const missing = traffic.nodes.flatMap((node) => node.messages).filter((message) => message.state === "missing").length;
    element("bus-load").textContent = `Load ${percent(traffic.load)} (of 100 ms at most ${percent(traffic.peak)}), `
        + `${traffic.frames} frames in ${traffic.duration_s.toFixed(2)} s, ${traffic.errors} error frames, `
        + `${missing} messages missing, ${traffic.unknown_count} unknown identifiers. Cycles in ms.`;
    const table = element("bus-messages");
    [...table.tBodies].forEach((body) => body.remove());
    table.append(...traffic.nodes.map((node) =>
        groupOf(`${node.name}: ${percent(node.share)}${node.silent ? ", silent" : ""}`, node.messages)));
    if (traffic.unknown_count) {
        table.append(groupOf(`Unknown: ${traffic.unknown_count} identifiers`, traffic.unknown));
    }
    element("no-bus-events").hidden = traffic.events.length > 0;
    element("bus-event-list").hidden = traffic.events.length === 0;
    if (traffic.events.length) {
        element("bus-events").tBodies[0].replaceChildren(...[...traffic.events].reverse().map((event) => {
            const time = make("button", { type: "button", textContent: `${(event.time_ns / 1e9).toFixed(4)} s` });
            time.addEventListener("click", () => show(event.time_ns));
            return make("tr", {}, make("td", {}, time), make("td", {}, ...breakable(event.text)));
        }));
    }
}
