// The controls beside the plots: tabs, run, faults, parameters, signals, cursors, record of a fault.

import { decimalsOf, textOf } from "./decoder.js";
import { COLOURS, PHASE_COLOURS, PHASE_NAMES } from "./palette.js";

export const element = (id) => document.getElementById(id);
const number = (id) => Number(element(id).value);

export function make(tag, properties = {}, ...children) {
    const made = Object.assign(document.createElement(tag), properties);
    made.append(...children);
    return made;
}

/** A name in a narrow column: it may break after an underscore. */
export function breakable(name) {
    return name.split(/(?<=_)/).flatMap((part, index) => (index ? [make("wbr"), part] : [part]));
}

/** Tabs for the panels whose commands the source has; the arrow keys go from one to the next. */
export function makeTabs(commands) {
    const panels = [...document.querySelectorAll("[role=tabpanel]")];
    const shown = panels.filter((panel) => !panel.dataset.needs || commands.includes(panel.dataset.needs));
    const tabs = shown.map((panel) => make("button", { type: "button", id: `${panel.id}-tab`, textContent:
                                                       panel.dataset.name }));
    const select = (chosen) => {
        panels.forEach((panel) => { panel.hidden = panel !== shown[chosen]; });
        tabs.forEach((tab, index) => {
            tab.setAttribute("aria-selected", index === chosen);
            tab.tabIndex = index === chosen ? 0 : -1;
        });
    };
    tabs.forEach((tab, index) => {
        tab.setAttribute("role", "tab");
        tab.setAttribute("aria-controls", shown[index].id);
        shown[index].setAttribute("aria-labelledby", tab.id);
        tab.addEventListener("click", () => select(index));
        tab.addEventListener("keydown", (event) => {
            const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
            if (step) {
                const next = (index + step + tabs.length) % tabs.length;
                select(next);
                tabs[next].focus();
                event.stopPropagation();
            }
        });
    });
    element("tabs").append(...tabs);
    select(0);
}

/** What was done in a log: {time_s, text} each; `show(time_ns)` when one is chosen. */
export function makeStimuli(acts, show) {
    element("stimuli").tBodies[0].append(...acts.map((act, index) => {
        const time = make("button", { type: "button", textContent: `${act.time_s.toFixed(6)} s` });
        time.addEventListener("click", () => show(act.time_s * 1e9));
        return make("tr", {}, make("td", { textContent: String(index + 1) }), make("td", {}, time),
                    make("td", {}, ...breakable(act.text)));
    }));
}

/** Speed, torque, load, stop: `act(name, args)` carries out a command and shows its refusal. */
export function makeRun(act, machine) {
    const onSubmit = (id, action) => element(id).addEventListener("submit", (event) => {
        event.preventDefault();
        action();
    });
    element("load-torque").value = String(+(machine.torque_rated_Nm / 2).toPrecision(1));
    element("torque-reference").value = String(+(machine.torque_rated_Nm / 4).toPrecision(1));
    element("speed-reference").value = String(Math.round(machine.speed_base_rpm * 0.4 / 10) * 10);
    onSubmit("speed-form", () => act("speed_reference", { rpm: number("speed-reference") }));
    onSubmit("torque-form", () => act("torque_reference", { Nm: number("torque-reference") }));
    onSubmit("load-form", () => act("load_torque", { Nm: number("load-torque") }));
    element("stop").addEventListener("click", () => act("stop", {}));
    element("stop-2").addEventListener("click", () => act("stop", {}));
    element("off").addEventListener("click", () => act("off", {}));
    element("clear-fault").addEventListener("click", () => act("clear_fault", {}));
    element("truth-period").addEventListener("change", () => act("truth_period", { us: number("truth-period") }));
}

/** The faults of the test bench, with the places and the attribute that each has. */
export function makeFaults(act, kinds, phases) {
    const words = (name) => name.replaceAll("_", " ");
    const select = element("fault-kind");
    select.append(...kinds.map((kind) => make("option", { value: kind.name, textContent: words(kind.name) })));
    element("fault-phase").append(...PHASE_NAMES.slice(0, phases).map((name) => make("option", {
        value: name.toLowerCase(), textContent: name })));
    const present = () => kinds.find((kind) => kind.name === select.value);
    const show = () => {
        const kind = present();
        const attribute = kind.attribute;
        element("fault-text").textContent = kind.text;
        element("fault-phase-row").hidden = !kind.phase;
        element("fault-leg-row").hidden = !kind.leg;
        element("fault-value-row").hidden = !attribute;
        if (attribute) {
            element("fault-value-name").textContent = words(attribute.name);
            element("fault-unit").textContent = attribute.unit;
            element("fault-value").hidden = Boolean(attribute.choices);
            element("fault-choice").hidden = !attribute.choices;
            element("fault-choice").replaceChildren(...(attribute.choices || []).map((choice) => make("option", {
                value: choice, textContent: choice })));
            Object.assign(element("fault-value"), { min: attribute.minimum, max: attribute.maximum, value: "",
                                                    placeholder: `${attribute.minimum} to ${attribute.maximum}` });
        }
    };
    select.addEventListener("change", show);
    element("fault-form").addEventListener("submit", (event) => {
        event.preventDefault();
        const kind = present();
        const args = { kind: kind.name };
        if (kind.phase) {
            args.phase = element("fault-phase").value;
        }
        if (kind.leg) {
            args.leg = element("fault-leg").value;
        }
        if (kind.attribute) {
            const field = element(kind.attribute.choices ? "fault-choice" : "fault-value");
            args.value = kind.attribute.choices ? field.value : Number(field.value);
        }
        if (element("fault-duration").value) {
            args.duration_s = number("fault-duration");
        }
        act("fault", args);
    });
    element("end-faults").addEventListener("click", () => act("end_faults", {}));
    element("clear-fault-2").addEventListener("click", () => act("clear_fault", {}));
    if (kinds.length) {
        show();
    }
}

/** The field of a parameter with its value as text: names to choose where its values have them. A value without a name
 *  is there as its number as long as the drive has it. */
function parameterField(row, choices, text) {
    const field = choices
        ? make("select", {}, ...[...new Set([...choices, text])].map((each) => new Option(each, each)))
        : make("input", { type: "number", step: "any" });
    field.value = text;
    field.setAttribute("aria-label", row.name);
    return field;
}

/** The drive's parameters: read, changed, and applied as one set. choices: names of values, by parameter. */
export function makeParameters(act, choices) {
    let rows = [];
    const body = element("parameters").tBodies[0];
    const changed = () => rows.filter((row) => row.input.value !== row.text);
    const plain = (value) => String(+value.toPrecision(7));
    const filter = () => {
        const wanted = element("parameter-filter").value.toLowerCase();
        rows.forEach((row) => { row.line.hidden = !row.name.toLowerCase().includes(wanted); });
    };
    const mark = () => {
        rows.forEach((row) => row.line.classList.toggle("changed", row.input.value !== row.text));
        element("apply-parameters").disabled = changed().length === 0;
    };
    const read = async () => {
        const answer = await act("parameters", {});
        if (!answer.ok) {
            return;
        }
        rows = answer.value.map((row) => {
            const names = choices[row.name];
            const text = names?.[row.value] ?? plain(row.value);
            const input = parameterField(row, names, text);
            input.addEventListener("input", mark);
            const unit = row.unit ? ` ${row.unit}` : "";
            const allowed = names ? [] : [make("td", { textContent: `${plain(row.minimum)} to ${plain(row.maximum)}${unit}` })];
            const line = make("tr", {}, make("th", { scope: "row" }, ...breakable(row.name)),
                              make("td", { colSpan: names ? 2 : 1 }, input), ...allowed);
            return { name: row.name, text, input, line };
        });
        body.replaceChildren(...rows.map((row) => row.line));
        filter();
        mark();
    };
    element("read-parameters").addEventListener("click", read);
    element("parameter-filter").addEventListener("input", filter);
    element("apply-parameters").addEventListener("click", async () => {
        const set = changed();
        const values = Object.fromEntries(set.map((row) => [row.name, row.name in choices ? row.input.value
            : Number(row.input.value)]));
        const answer = await act("set_parameters", { values });
        if (answer.ok) {
            set.forEach((row) => { row.text = row.input.value; });
            mark();
        }
    });
    element("save-parameters").addEventListener("click", () => act("save_parameters", {}));
}

/** Every signal of both databases to choose; `onChoice(names)`. */
export function makeSignals(messages, chosen, onChoice) {
    const root = element("signals");
    const boxes = [];
    for (const message of messages.filter((candidate) => candidate.node !== "HOST")) {
        const fields = make("fieldset", {}, make("legend", { textContent: message.name, title: message.comment }));
        for (const signal of message.signals) {
            const name = `${message.name}.${signal.name}`;
            const box = make("input", { type: "checkbox", value: name, checked: chosen.includes(name) });
            fields.append(make("label", { title: signal.comment }, box, make("span", { textContent: signal.name }),
                               make("span", { textContent: signal.unit })));
            boxes.push(box);
            box.addEventListener("change", () => onChoice(boxes.filter((each) => each.checked).map((each) => each.value)));
        }
        root.append(fields);
    }
    element("signal-filter").addEventListener("input", (event) => {
        const wanted = event.target.value.toLowerCase();
        root.querySelectorAll("fieldset").forEach((fields) => {
            let any = false;
            fields.querySelectorAll("label").forEach((label) => {
                label.hidden = !label.querySelector("input").value.toLowerCase().includes(wanted);
                any = any || !label.hidden;
            });
            fields.hidden = !any;
        });
    });
}

/** Values of the shown signals at two times. */
export function showCursors(marks, list) {
    const body = element("cursors").tBodies[0];
    const cell = (text) => make("td", { textContent: text });
    const time = (time_ns) => (time_ns === undefined ? "–" : `${(time_ns / 1e9).toFixed(6)} s`);
    const both = marks.A !== undefined && marks.B !== undefined;
    const rows = [make("tr", {}, make("th", { scope: "row", textContent: "time" }), cell(time(marks.A)),
                       cell(time(marks.B)), cell(both ? `${((marks.B - marks.A) / 1e6).toFixed(3)} ms` : "–"))];
    for (const series of list) {
        const [a, b] = [marks.A, marks.B].map((time_ns) => (time_ns === undefined ? NaN : series.at(time_ns)));
        const difference = series.signal.choices || !Number.isFinite(b - a) ? "–"
            : (b - a).toFixed(decimalsOf(series.signal)).replace("-", "−");
        rows.push(make("tr", {}, make("th", { scope: "row" }, ...breakable(series.signal.name), make("small", {
            textContent: ` ${series.signal.unit}` })), cell(textOf(series.signal, a)), cell(textOf(series.signal, b)),
            cell(difference)));
    }
    body.replaceChildren(...rows);
}

/** The faults of the bench that are present, by the reports of the bench up to a time, each with a button to end it.
 *  store: of the frames; kinds: as of makeFaults. */
export class ActiveFaults {
    constructor(act, store, kinds) {
        this.act = act;
        this.kinds = new Map(kinds.map((kind) => [kind.name, kind]));
        this.reports = ["kind", "phase", "leg", "present"].map((name) => store.watch(`RIG_TRUTH_FAULT.${name}`));
        this.shown = -1;
    }

    /** Reports so far, each of a fault that begins or ends. */
    get reported() {
        return this.reports[0]?.size ?? 0;
    }

    /** What ends each fault that is present after a number of reports, by its text. */
    presentAfter(count) {
        const [kinds, phases, legs, present] = this.reports;
        const active = new Map();
        for (let i = 0; i < count; i++) {
            const name = textOf(kinds.signal, kinds.value[i]);
            const kind = this.kinds.get(name);
            const args = { kind: name };
            if (kind && kind.phase) {
                args.phase = PHASE_NAMES[phases.value[i]].toLowerCase();
            }
            if (kind && kind.leg) {
                args.leg = legs.signal.choices[String(legs.value[i])];
            }
            const key = Object.values(args).join(" ");
            active.delete(key);
            if (present.value[i]) {
                active.set(key, args);
            }
        }
        return active;
    }

    show(at_ns) {
        const until = this.reports[0]?.indexAt(at_ns + 1) ?? 0;
        if (until === this.shown) {
            return;
        }
        this.shown = until;
        const active = this.presentAfter(until);
        element("active-faults").replaceChildren(...[...active].map(([key, args]) => {
            const end = make("button", { type: "button", textContent: "End" });
            end.addEventListener("click", () => this.act("end_fault", args));
            return make("li", {}, `${key.replaceAll("_", " ")} `, end);
        }));
        element("no-active-faults").hidden = active.size > 0;
    }
}

/** The record of the last fault, and the log of faults. */
export function makeRecord(act) {
    element("read-record").addEventListener("click", async () => {
        const log = await act("fault_log", {});
        if (log.ok) {
            element("fault-log").tBodies[0].replaceChildren(...[...log.value].reverse().map((fault) => make("tr", {},
                make("td", { textContent: `${fault.number} ${fault.fault} in ${fault.state}` }),
                make("td", { textContent: `${fault.time_s.toFixed(3)} s` }),
                make("td", { textContent: `${fault.speed_rpm.toFixed(0)} r/min` }),
                make("td", { textContent: `${fault.current_max_A.toFixed(1)} A` }),
                make("td", { textContent: `${fault.bus_voltage_V.toFixed(0)} V` }))));
        }
        const trace = await act("fault_trace", {});
        if (trace.ok) {
            showRecord(trace.value);
        }
    });
}

/** A scale in which also a constant can be read. */
export function withMargin(low, high, least = 0.05) {
    const margin = Math.max(0.08 * (high - low), 0.01 * Math.abs(high), least);
    return [low - margin, high + margin];
}

function showRecord(trace) {
    const dialog = element("record");
    const root = element("record-plots");
    root.replaceChildren();
    dialog.showModal();
    const time_us = trace.time_s.map((time) => time * 1e6);
    const phases = trace.current_A[0].length;
    const column = (rows, phase) => rows.map((row) => row[phase]);
    const each = (make_) => PHASE_NAMES.slice(0, phases).map((name, phase) => make_(name, phase));
    const duties = each((name, phase) => [
        { label: `${name} upper`, values: column(trace.upper_duty, phase), stroke: PHASE_COLOURS[phase] },
        { label: `${name} lower`, values: column(trace.lower_duty, phase), stroke: PHASE_COLOURS[phase], dash: [4, 3] },
    ]).flat();
    const plots = [
        ["phase currents, A", each((name, phase) => ({ label: name, values: column(trace.current_A, phase),
                                                       stroke: PHASE_COLOURS[phase] }))],
        ["duties of the upper (line) and lower (dashes) switches", duties],
        ["speed, r/min", [{ label: "speed", values: trace.speed_rpm, stroke: COLOURS[0] }]],
        ["DC link, V", [{ label: "DC link", values: trace.bus_voltage_V, stroke: COLOURS[1] }]],
    ];
    const width = root.clientWidth;
    for (const [title, lines] of plots) {
        root.append(make("p", { className: "hint", textContent: title }));
        new uPlot({
            width, height: Math.max(100, Math.min(150, (0.94 * innerHeight - 300) / plots.length)), legend: { show: false },
            padding: [4, 28, 0, 0],
            scales: { x: { time: false }, y: { range: (plot, low, high) => withMargin(low, high) } },
            axes: [{ size: 26, values: (plot, ticks) => ticks.map((tick) => `${tick} µs`.replace("-", "−")),
                     space: 80 }, { size: 52, space: 22 }],
            series: [{}, ...lines.map((each_) => ({ stroke: each_.stroke, dash: each_.dash, width: 1.5,
                                                     points: { show: false },
                                                     paths: uPlot.paths.stepped({ align: 1 }) }))],
        }, [time_us, ...lines.map((each_) => each_.values)], root);
    }
    root.append(make("p", { className: "hint", textContent: each((name) => name).join(", ")
        + " in the colours of the picture of the machine; 0 µs: the period in which the drive stopped." }));
}
