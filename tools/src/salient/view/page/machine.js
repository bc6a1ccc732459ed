// The machine cut across its shaft, and the loops of its phases in the plane of flux linkage and current.

import { PHASE_COLOURS, PHASE_NAMES, withOpacity } from "./palette.js";

const SIGNALS = {
    angle: ["RIG_TRUTH_BENCH.rotor_angle_deg", "DRIVE_MOTION.rotor_angle_deg"],
    currents: ["a", "b", "c", "d", "e", "f"].map((phase, number) => [
        `RIG_TRUTH_CURRENTS.current_${phase}_A`,
        `${number < 4 ? "DRIVE_CURRENTS" : "DRIVE_PHASES_E_F"}.current_${phase}_A`]),
};
const OFF_PART = 0.01; // of the peak current: the phase is off
const VOLTAGE_PART = 0.25; // of the supply: both switches on or both off, for most of the time between two samples
const LOOP_POINTS_MIN = 4;
const STROKES_SEARCHED = 3;

/** Angle, currents and flux linkage of the machine from the signals that are on the bus. */
export class MachineState {
    constructor(store, machine) {
        this.machine = machine;
        this.pitch_deg = 360 / machine.rotor_poles;
        this.store = store;
        this.angles = SIGNALS.angle.map((name) => store.watch(name)).filter(Boolean);
        this.currents = SIGNALS.currents.slice(0, machine.phases)
            .map((names) => names.map((name) => store.watch(name)).filter(Boolean));
    }

    /** True when the test bench sends the true state; else the measured one of the drive is shown. */
    get isTrue() {
        return this.angles[0].size > 0 && this.currents.every((list) => list[0].size > 0);
    }

    get angle() {
        return this.isTrue ? this.angles[0] : this.angles[this.angles.length - 1];
    }

    current(phase) {
        const list = this.currents[phase];
        return this.isTrue ? list[0] : list[list.length - 1];
    }

    /** Mechanical angle at a time, between samples on the shorter way. */
    angleAt(time_ns) {
        const series = this.angle;
        const after = series.indexAt(time_ns);
        if (after === 0 || after === series.size) {
            return series.at(time_ns);
        }
        const first = series.value[after - 1];
        const way = ((series.value[after] - first + 540) % 360) - 180;
        const span = series.time[after] - series.time[after - 1];
        return first + (span > 0 ? way * (time_ns - series.time[after - 1]) / span : way);
    }

    /** Angle of a phase from its aligned position, 0 to the pole pitch. */
    phaseAngle(phase, angle_deg) {
        const angle = angle_deg - phase * this.pitch_deg / this.machine.phases;
        return ((angle % this.pitch_deg) + this.pitch_deg) % this.pitch_deg;
    }

    /** Flux linkage by the map of the machine file, linear between its points. */
    fluxLinkage(phase_angle_deg, current_A) {
        const { angle_deg, current_A: currents, flux_linkage_Wb } = this.machine.flux_map;
        const column = Math.min(angle_deg.length - 2, Math.floor(phase_angle_deg / angle_deg[1]));
        const row = Math.max(0, Math.min(currents.length - 2, Math.floor(current_A / currents[1])));
        const x = phase_angle_deg / angle_deg[1] - column;
        const y = current_A / currents[1] - row;
        const [low, high] = [flux_linkage_Wb[row], flux_linkage_Wb[row + 1]];
        return (1 - y) * ((1 - x) * low[column] + x * low[column + 1])
            + y * ((1 - x) * high[column] + x * high[column + 1]);
    }

    fluxAt(phase, time_ns) {
        return this.fluxLinkage(this.phaseAngle(phase, this.angleAt(time_ns)), this.current(phase).between(time_ns));
    }

    /** "+" both switches on, "0" one on, "−" both off, "" without current: by the mean voltage of the winding between
     *  two samples, R i + d psi / d t. */
    switching(phase, time_ns) {
        const series = this.current(phase);
        const after = series.indexAt(time_ns);
        if (after === 0 || after >= series.size) {
            return "";
        }
        const [from_ns, to_ns] = [series.time[after - 1], series.time[after]];
        const current_A = (series.value[after - 1] + series.value[after]) / 2;
        if (Math.max(series.value[after - 1], series.value[after]) < OFF_PART * this.machine.current_peak_A) {
            return "";
        }
        const rise_V = (this.fluxAt(phase, to_ns) - this.fluxAt(phase, from_ns)) / ((to_ns - from_ns) * 1e-9);
        const part = (rise_V + this.machine.resistance_ohm * current_A) / this.machine.supply_voltage_V;
        return part > VOLTAGE_PART ? "+" : part < -VOLTAGE_PART ? "−" : "0";
    }

    /** The last whole stroke of a phase before a time: currents and flux linkages, and its work; undefined when the
     *  shaft has not turned so far, or too fast for the samples. */
    stroke(phase, time_ns) {
        const series = this.current(phase);
        const points = [];
        let ends = 0;
        let last = NaN;
        for (let i = series.indexAt(time_ns + 1) - 1; i >= 0 && ends <= STROKES_SEARCHED; i--) {
            const angle = this.phaseAngle(phase, this.angleAt(series.time[i]));
            // The phase is without current where it is unaligned: a stroke begins and ends there.
            const half = this.pitch_deg / 2;
            if ((last - half) * (angle - half) < 0 && Math.abs(last - angle) < half) {
                ends += 1;
                if (ends === 2) {
                    break;
                }
            }
            if (ends === 1) {
                points.push([Math.max(0, series.value[i]), this.fluxLinkage(angle, Math.max(0, series.value[i]))]);
            }
            last = angle;
            if (series.time[i] < time_ns - 3e9) {
                return undefined; // standstill
            }
        }
        if (ends < 2 || points.length < LOOP_POINTS_MIN) {
            return undefined;
        }
        points.reverse();
        let work_J = 0;
        points.forEach(([current, flux], i) => {
            const [next, nextFlux] = points[(i + 1) % points.length];
            work_J += 0.5 * (current + next) * (nextFlux - flux); // i d psi
        });
        return { points, work_J };
    }
}

function prepared(canvas) {
    const width = canvas.clientWidth;
    const height = canvas.clientHeight;
    if (canvas.width !== Math.round(width * devicePixelRatio) || canvas.height !== Math.round(height * devicePixelRatio)) {
        canvas.width = Math.round(width * devicePixelRatio);
        canvas.height = Math.round(height * devicePixelRatio);
    }
    const context = canvas.getContext("2d");
    context.setTransform(devicePixelRatio, 0, 0, devicePixelRatio, 0, 0);
    context.clearRect(0, 0, width, height);
    return { context, width, height };
}

/** A shape between two radii and two angles. */
function sector(context, inner, outer, from, to) {
    context.beginPath();
    context.arc(0, 0, outer, from, to);
    context.arc(0, 0, inner, to, from, true);
    context.closePath();
}

/** The phase whose aligned position is at a stator pole. */
export function phaseOfPole(machine, pole) {
    const pitch = 360 / machine.rotor_poles;
    const angle = (pole * 360 / machine.stator_poles) % pitch;
    return Math.round(angle / (pitch / machine.phases)) % machine.phases;
}

export function drawMachine(canvas, state, time_ns) {
    const { context, width, height } = prepared(canvas);
    const { machine } = state;
    const size = Math.min(width, height) / 2 - 4;
    const angle = (state.angleAt(time_ns) || 0) * Math.PI / 180;
    const poleArc = 0.42 * 2 * Math.PI / machine.stator_poles;
    const rotorArc = Math.min(0.42 * 2 * Math.PI / machine.rotor_poles, 1.15 * poleArc);
    const [outer, yoke, bore, gap, root, shaft] = [1, 0.84, 0.56, 0.54, 0.34, 0.13].map((part) => part * size);
    context.translate(width / 2, height / 2);
    context.rotate(-Math.PI / 2); // phase A on top
    context.lineWidth = 1;

    context.fillStyle = "#d9dcdf";
    context.strokeStyle = "#6b7076";
    sector(context, yoke, outer, 0, 2 * Math.PI);
    context.fill("evenodd");
    for (let pole = 0; pole < machine.stator_poles; pole++) {
        // Angles of the machine are positive in the direction of the rotation; the canvas' too.
        const middle = pole * 2 * Math.PI / machine.stator_poles;
        context.fillStyle = "#d9dcdf";
        sector(context, bore, yoke + 1, middle - poleArc / 2, middle + poleArc / 2);
        context.fill();
        const phase = phaseOfPole(machine, pole);
        const current_A = state.current(phase).between(time_ns) || 0;
        const part = Math.max(0, Math.min(1, current_A / machine.current_peak_A));
        const sign = state.switching(phase, time_ns);
        const coil = 0.3 * (2 * Math.PI / machine.stator_poles - poleArc);
        for (const side of [-1, 1]) {
            const near = middle + side * poleArc / 2;
            const far = near + side * coil;
            sector(context, bore + 0.03 * size, yoke - 0.02 * size, Math.min(near, far), Math.max(near, far));
            context.fillStyle = withOpacity(PHASE_COLOURS[phase], 0.08 + 0.92 * part);
            context.fill();
            context.strokeStyle = PHASE_COLOURS[phase];
            context.lineWidth = sign === "+" ? 2.5 : 1;
            context.setLineDash(sign === "−" ? [3, 2] : []);
            context.stroke();
        }
        context.setLineDash([]);
        context.save();
        context.rotate(middle);
        context.translate((yoke + outer) / 2, 0);
        context.rotate(Math.PI / 2 - middle);
        context.fillStyle = "#111";
        context.font = "600 12px system-ui, sans-serif";
        context.textAlign = "center";
        context.textBaseline = "middle";
        context.fillText(PHASE_NAMES[phase] + sign, 0, 0);
        context.restore();
    }
    context.lineWidth = 1;
    context.strokeStyle = "#6b7076";
    context.beginPath();
    context.arc(0, 0, outer, 0, 2 * Math.PI);
    context.stroke();

    context.rotate(angle);
    context.fillStyle = "#8d949b";
    context.beginPath();
    context.arc(0, 0, root, 0, 2 * Math.PI);
    context.fill();
    for (let pole = 0; pole < machine.rotor_poles; pole++) {
        const middle = pole * 2 * Math.PI / machine.rotor_poles;
        sector(context, root - 2, gap, middle - rotorArc / 2, middle + rotorArc / 2);
        context.fill();
    }
    context.fillStyle = "#fff";
    context.beginPath();
    context.arc(0, 0, shaft, 0, 2 * Math.PI);
    context.fill();
    context.fillStyle = "#111"; // shows which way the rotor has turned
    context.beginPath();
    context.arc((gap + root) / 2, 0, 0.03 * size, 0, 2 * Math.PI);
    context.fill();
}

/** Draws the last stroke of each phase over the magnetisation curves; returns the work of each in J, and the samples
 *  of the first. */
export function drawLoops(canvas, state, time_ns) {
    const { context, width, height } = prepared(canvas);
    const { machine } = state;
    const { current_A: currents, flux_linkage_Wb: map } = machine.flux_map;
    const [left, right, top, bottom] = [46, 10, 10, 34];
    const current_max = currents[currents.length - 1];
    const flux_max = 1.06 * Math.max(...map.map((row) => row[0]));
    const scale = flux_max < 0.2 ? 1e3 : 1;
    const x = (current) => left + current / current_max * (width - left - right);
    const y = (flux) => height - bottom - flux / flux_max * (height - top - bottom);
    context.font = "11px system-ui, sans-serif";
    context.lineWidth = 1;
    context.fillStyle = "#333";
    for (const tick of ticksOf(current_max, 4)) {
        line(context, "#e8e8e8", [[x(tick), y(0)], [x(tick), top]]);
        context.textAlign = "center";
        context.fillText(`${tick}`, x(tick), height - bottom + 13);
    }
    for (const tick of ticksOf(flux_max * scale, 4)) {
        line(context, "#e8e8e8", [[left, y(tick / scale)], [width - right, y(tick / scale)]]);
        context.textAlign = "right";
        context.fillText(`${tick}`, left - 4, y(tick / scale) + 4);
    }
    context.textAlign = "center";
    context.fillText("current, A", (left + width - right) / 2, height - 5);
    context.save();
    context.translate(11, (top + height - bottom) / 2);
    context.rotate(-Math.PI / 2);
    context.fillText(`flux linkage, ${scale === 1 ? "Wb" : "mWb"}`, 0, 0);
    context.restore();
    const unaligned = Math.round((map[0].length - 1) / 2);
    for (const column of [0, unaligned]) {
        line(context, "#9aa0a6", map.map((row, index) => [x(currents[index]), y(row[column])]));
    }
    const work = [];
    let samples = 0;
    for (let phase = 0; phase < machine.phases; phase++) {
        const stroke = state.stroke(phase, time_ns);
        work.push(stroke ? stroke.work_J : NaN);
        samples = samples || (stroke ? stroke.points.length : 0);
        const colour = PHASE_COLOURS[phase];
        if (stroke) {
            context.lineWidth = 1.75;
            line(context, colour, [...stroke.points, stroke.points[0]].map(([i, flux]) => [x(i), y(flux)]));
            context.fillStyle = withOpacity(colour, 0.07);
            context.fill();
        }
        const current_A = state.current(phase).between(time_ns);
        if (Number.isFinite(current_A)) {
            context.fillStyle = colour;
            context.beginPath();
            context.arc(x(current_A), y(state.fluxAt(phase, time_ns)), 4, 0, 2 * Math.PI);
            context.fill();
        }
    }
    return { work, samples };
}

function line(context, colour, points) {
    context.strokeStyle = colour;
    context.beginPath();
    points.forEach(([x, y], index) => (index ? context.lineTo(x, y) : context.moveTo(x, y)));
    context.stroke();
}

/** Round numbers from 0 to a maximum. */
function ticksOf(maximum, count) {
    const rough = maximum / count;
    const power = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].map((factor) => factor * power).find((candidate) => candidate >= rough);
    const ticks = [];
    for (let tick = 0; tick <= maximum; tick += step) {
        ticks.push(+tick.toPrecision(6));
    }
    return ticks;
}
