// Runs of the drive in a tab, in Node: node tab_run.mjs TAB.html < JSON
//
// [{ machine, options, ahead, link, variables, steps }], each step { to_ns }, { name, args } or { back_ns }; prints for each
// run its variables where asked for, frames, answers, the hash after each step, the comparisons of hashes, its link.

import { readFileSync } from "node:fs";
import { databasesOf, readData } from "../../tools/src/salient/tab/page/data.js";
import { readLink, writeLink } from "../../tools/src/salient/tab/page/link.js";
import { Messages } from "../../tools/src/salient/tab/page/messages.js";
import { Run } from "../../tools/src/salient/tab/page/run.js";
import { Variables } from "../../tools/src/salient/tab/page/variables.js";

const data = await readData(readFileSync(process.argv[2], "utf8").match(/id="tab-data">([^<]*)</)[1]);
const module = await WebAssembly.compile(data.module);
const results = [];
for (const given of JSON.parse(readFileSync(0, "utf8"))) {
    const setting = given.link ? await readLink(given.link) : { machine: "saturating", options: {}, events: [], ...given };
    const frames = [];
    const same = [];
    const run = new Run({
        messages: new Messages(databasesOf(data, setting.machine), data.data_ids), faults: data.faults,
        choices: data.parameter_choices, variables: new Variables(data.variables, data.machines[setting.machine].factors),
        onFrame: (timeNs, id, length, bytes) => frames.push(
            [timeNs, id >>> 0, Buffer.from(bytes.slice(0, length)).toString("hex")]),
        onSame: (timeNs, isSame) => same.push([timeNs, isSame]),
    });
    const ahead = setting.hash === undefined ? setting.events
        : [...setting.events, { timeNs: setting.untilNs, hash: setting.hash }];
    await run.start(module, data.images[setting.machine], setting.options, ahead);
    const answers = [];
    const hashes = [];
    for (const step of given.steps) {
        if (step.to_ns !== undefined) {
            run.advanceTo(step.to_ns);
        } else if (step.back_ns !== undefined) {
            run.rewindTo(step.back_ns);
        } else {
            answers.push(run.command(step.name, step.args));
        }
        hashes.push(run.world.hash);
    }
    const { events, untilNs, hash } = run.record();
    const variables = given.variables ? [...run.known.variables.byName.values()] : [];
    results.push({ variables, frames, answers, hashes, same, time_ns: run.timeNs, memory_bytes: run.world.memoryBytes,
                   link: await writeLink({ build: data.build, machine: setting.machine, options: setting.options, events,
                                           untilNs, hash }) });
}
process.stdout.write(JSON.stringify(results));
