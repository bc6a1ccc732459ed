// Steps of the page's first run, in Node: node first_run_steps.mjs < JSON
//
// [[seen, ...], ...], each a visit with what the page has seen one after the other; prints [step, number, line] of each.

import { readFileSync } from "node:fs";
import { lineOf, Progress } from "../../tools/src/salient/view/page/first_run.js";

const visits = JSON.parse(readFileSync(0, "utf8"));
process.stdout.write(JSON.stringify(visits.map((visit) => {
    const progress = new Progress();
    return visit.map((seen) => {
        const step = progress.take(seen);
        return [step, progress.steps.indexOf(step) + 1, lineOf(step, seen)];
    });
})));
