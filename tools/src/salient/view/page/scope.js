// The drive's triggered buffer: arming it, and its contents with cursors and spectra.

import { element, make, withMargin } from "./controls.js";
import { COLOURS } from "./palette.js";

const POLL_MS = 250;
const FONT = "12px system-ui, sans-serif";

const short = (value) => String(+value.toPrecision(6)).replace("-", "−");

/** Amplitudes of a signal at equal steps: {frequency_Hz[], amplitude[]}, from 0 to half of the rate. A Hann window, whose
 *  mean of 1/2 is made up for; a sine between two lines is shown by up to 15 % too small. Its mean is taken off. */
export function spectrum(values, step_s) {
    const size = 2 ** Math.floor(Math.log2(values.length));
    const part = values.slice(0, size);
    const mean = part.reduce((sum, value) => sum + value, 0) / size;
    const re = part.map((value, i) => (value - mean) * (1 - Math.cos((2 * Math.PI * i) / size)));
    const im = new Array(size).fill(0);
    transform(re, im);
    const frequency_Hz = [];
    const amplitude = [];
    for (let line = 0; line <= size / 2; line++) {
        frequency_Hz.push(line / (size * step_s));
        amplitude.push((Math.hypot(re[line], im[line]) * (line === 0 || line === size / 2 ? 1 : 2)) / size);
    }
    return { frequency_Hz, amplitude };
}

/** Fast Fourier transform in place, of 2^n values (Cooley and Tukey, 1965). */
function transform(re, im) {
    const size = re.length;
    for (let i = 1, j = 0; i < size; i++) {
        let bit = size >> 1;
        for (; j & bit; bit >>= 1) {
            j ^= bit;
        }
        j ^= bit;
        if (i < j) {
            [re[i], re[j]] = [re[j], re[i]];
            [im[i], im[j]] = [im[j], im[i]];
        }
    }
    for (let length = 2; length <= size; length *= 2) {
        for (let k = 0; k < length / 2; k++) {
            const [cosine, sine] = [Math.cos((2 * Math.PI * k) / length), -Math.sin((2 * Math.PI * k) / length)];
            for (let begin = k; begin < size; begin += length) {
                const other = begin + length / 2;
                const [x, y] = [re[other] * cosine - im[other] * sine, re[other] * sine + im[other] * cosine];
                [re[other], im[other]] = [re[begin] - x, im[begin] - y];
                [re[begin], im[begin]] = [re[begin] + x, im[begin] + y];
            }
        }
    }
}

/** The panel: signals and trigger, and the wait for the buffer. */
export function makeScope(act) {
    const state = element("scope-state");
    let waiting = 0; // number of the arming that is waited for
    let known = false;
    const tell = (text) => { state.textContent = text; };
    element("scope-signals").addEventListener("focus", async () => {
        if (!known) {
            known = true;
            const names = await act("scope_names", {});
            element("scope-names").textContent = names.ok ? names.value.join(", ") : "";
        }
    });
    element("scope-form").addEventListener("submit", async (event) => {
        event.preventDefault();
        const own = ++waiting;
        const answer = await act("scope_arm", {
            signals: element("scope-signals").value.split(/[\s,]+/).filter((name) => name),
            trigger: element("scope-trigger").value.trim(),
            before: Number(element("scope-before").value) / 100, divider: Number(element("scope-divider").value) });
        element("scope-now").disabled = !answer.ok;
        tell(answer.ok ? "Waits for the trigger." : "");
        while (answer.ok && own === waiting) {
            await new Promise((resolve) => setTimeout(resolve, POLL_MS));
            const read = await act("scope_read", {});
            if (own !== waiting || !read.ok) {
                break;
            }
            if (read.value.state === "complete") {
                tell("");
                element("scope-now").disabled = true;
                new Recording(read.value);
                break;
            }
            tell(read.value.state === "reads" ? "Reads the buffer." : "Waits for the trigger.");
        }
    });
    element("scope-now").addEventListener("click", () => act("scope_trigger", {}));
}

/** The contents in a dialog: a plot for each signal, over time or over frequency, with two cursors. */
class Recording {
    constructor(recording) {
        this.recording = recording;
        this.step_s = recording.time_s[1] - recording.time_s[0];
        this.isSpectrum = false;
        element("recording-title").textContent = `The drive's buffer: ${recording.title}`;
        element("recording-spectrum").onclick = () => this.change(!this.isSpectrum);
        element("recording-close").onclick = () => element("recording").close();
        element("recording").show(); // not modal: the drive runs, and Stop and Escape stop it
        this.change(false);
    }

    change(isSpectrum) {
        this.isSpectrum = isSpectrum;
        this.marks = [];
        element("recording-spectrum").setAttribute("aria-pressed", isSpectrum);
        const root = element("recording-plots");
        root.replaceChildren();
        const { signals, time_s } = this.recording;
        this.x = isSpectrum ? spectrum(signals[0].values, this.step_s).frequency_Hz : time_s.map((time) => 1e3 * time);
        this.unit = isSpectrum ? "Hz" : "ms";
        this.shown = signals.filter((signal) => !isSpectrum || !signal.choices).map((signal) => ({
            ...signal, values: isSpectrum ? spectrum(signal.values, this.step_s).amplitude : signal.values }));
        this.plots = this.shown.map((signal, index) => this.plot(root, signal, COLOURS[index % COLOURS.length]));
        this.showMarks();
    }

    plot(root, signal, colour) {
        root.append(make("p", { className: "hint", textContent: `${signal.name}${signal.unit ? `, ${signal.unit}` : ""}`
            + `${this.isSpectrum ? ", amplitude" : ""}` }));
        const names = (ticks) => ticks.map((tick) => (signal.choices ? signal.choices[tick] ?? "" : short(tick)));
        const plot = new uPlot({
            width: root.clientWidth,
            height: Math.max(90, Math.min(170, (0.94 * innerHeight - 300) / this.shown.length)),
            legend: { show: false }, padding: [4, 28, 0, 0],
            scales: { x: { time: false }, y: { range: (_, low, high) => withMargin(low, high, 1e-9) } },
            axes: [{ size: 26, space: 80, font: FONT, values: (_, ticks) => ticks.map((tick) => `${short(tick)} ${this.unit}`) },
                   { size: this.shown.some((each) => each.choices) ? 90 : 58, space: 22, font: FONT, values: (_, ticks) => names(ticks),
                     ...(signal.choices ? { incrs: [1, 2, 5] } : {}) }],
            cursor: { sync: { key: "recording" }, points: { show: false }, drag: { x: true, y: false } },
            series: [{}, { stroke: colour, width: 1.5, points: { show: false },
                           ...(this.isSpectrum ? {} : { paths: uPlot.paths.stepped({ align: 1 }) }) }],
            hooks: { draw: [(drawn) => this.draw(drawn)] },
        }, [this.x, signal.values], root);
        plot.over.addEventListener("click", (event) => this.mark(plot.posToVal(event.offsetX, "x")));
        return plot;
    }

    /** The first click sets A, the next one B, a further one moves the nearer. */
    mark(x) {
        const index = this.x.reduce((best, value, i) => (Math.abs(value - x) < Math.abs(this.x[best] - x) ? i : best), 0);
        if (this.marks.length < 2) {
            this.marks.push(index);
        } else {
            const [a, b] = this.marks.map((at) => Math.abs(this.x[at] - x));
            this.marks[a <= b ? 0 : 1] = index;
        }
        this.showMarks();
        this.plots.forEach((plot) => plot.redraw());
    }

    draw(plot) {
        const { ctx } = plot;
        ctx.save();
        ctx.fillStyle = "#333";
        ctx.strokeStyle = "#333";
        ctx.font = `${12 * devicePixelRatio}px system-ui, sans-serif`;
        const line = (x, name, dash) => {
            const at = plot.valToPos(x, "x", true);
            if (at < plot.bbox.left || at > plot.bbox.left + plot.bbox.width) {
                return;
            }
            ctx.setLineDash(dash);
            ctx.beginPath();
            ctx.moveTo(at, plot.bbox.top);
            ctx.lineTo(at, plot.bbox.top + plot.bbox.height);
            ctx.stroke();
            ctx.fillText(name, at + 4, plot.bbox.top + 12 * devicePixelRatio);
        };
        if (!this.isSpectrum) {
            line(0, "", [2, 4]);
        }
        this.marks.forEach((index, number) => line(this.x[index], "AB"[number], []));
        ctx.restore();
    }

    showMarks() {
        const [a, b] = this.marks;
        const cell = (text) => make("td", { textContent: text });
        const text = (signal, index) => (index === undefined ? "–"
            : signal.choices ? signal.choices[signal.values[index]] : short(signal.values[index]));
        const difference = (values, isState) => (isState || b === undefined ? "–" : short(values[b] - values[a]));
        const row = (name, signal) => make("tr", {}, make("th", { scope: "row", textContent: name }),
            cell(text(signal, a)), cell(text(signal, b)), cell(difference(signal.values, signal.choices)));
        element("recording-cursors").tBodies[0].replaceChildren(
            row(this.isSpectrum ? "frequency, Hz" : "time, ms", { values: this.x }),
            ...this.shown.map((signal) => row(`${signal.name}${signal.unit ? `, ${signal.unit}` : ""}`, signal)));
    }
}
