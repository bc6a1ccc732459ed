// Plots of signals over time: one for each unit, all over the same time.

import { decimalsOf, nameOf, textOf } from "./decoder.js";
import { lineStyle } from "./palette.js";

const HEIGHT_MIN = 110;
const HEIGHT_STACKED = 160; // where the page is one column
const ONE_COLUMN = matchMedia("(max-width: 900px)"); // as in style.css
const AXIS_WIDTH = 58;
const NAME_LENGTH = 9; // of a value's name beside an axis
const STIMULUS_COLOUR = "#007a58";

/** Minimum and maximum of each column of the plot, in two points a column; the same times for all signals. */
export function reduced(series, grid) {
    const points = new Array(grid.time_s.length).fill(null);
    const { from_ns, column_ns, columns } = grid;
    let index = series.indexAt(from_ns);
    const before = index > 0 ? index - 1 : -1;
    if (before >= 0) {
        points[0] = series.value[before]; // so that the line begins at the edge
    }
    while (index < series.size) {
        const column = Math.floor((series.time[index] - from_ns) / column_ns);
        if (column >= columns) {
            break;
        }
        const end_ns = from_ns + (column + 1) * column_ns;
        let lowest = index;
        let highest = index;
        for (index += 1; index < series.size && series.time[index] < end_ns; index++) {
            lowest = series.value[index] < series.value[lowest] ? index : lowest;
            highest = series.value[index] > series.value[highest] ? index : highest;
        }
        points[2 * column] = series.value[Math.min(lowest, highest)];
        points[2 * column + 1] = lowest === highest ? points[2 * column + 1] : series.value[Math.max(lowest, highest)];
    }
    return points;
}

/** Columns that stand still while time goes on: their edges are multiples of their width. */
export function gridOf(from_ns, to_ns, columns) {
    const column_ns = (to_ns - from_ns) / columns;
    const start_ns = Math.floor(from_ns / column_ns) * column_ns;
    const time_s = [];
    for (let column = 0; column <= columns + 1; column++) {
        time_s.push((start_ns + (column + 0.25) * column_ns) / 1e9, (start_ns + (column + 0.75) * column_ns) / 1e9);
    }
    return { from_ns: start_ns, column_ns, columns: columns + 2, time_s };
}

/** A number that fits beside an axis. */
function shortNumber(value) {
    const plain = +value.toPrecision(7);
    return (Math.abs(plain) >= 1e5 ? `${+(plain / 1e6).toPrecision(5)}M` : String(plain)).replace("-", "−");
}

/** Scale of an axis: never of no height, and whole least significant bits do not fill it. */
function rangeOf(list) {
    const resolution = Math.max(...list.map((series) => (series.signal.float ? 1e-3 : series.signal.factor)));
    return (plot, low, high) => {
        if (low === null || high === null) {
            return [0, 1];
        }
        const margin = Math.max((high - low) * 0.06, 4 * resolution);
        return [low - margin, high + margin];
    };
}

class Plot {
    constructor(charts, unit, list, indexOf) {
        this.list = list;
        this.unit = unit;
        this.element = document.createElement("section");
        this.element.className = "plot";
        this.legend = document.createElement("ul");
        this.legend.className = "legend";
        this.body = document.createElement("div");
        this.body.className = "plot-body";
        this.element.append(this.legend, this.body);
        this.values = list.map((series) => this.addToLegend(charts, series, lineStyle(indexOf(series))));
        charts.root.append(this.element);
        const states = list.every((series) => series.signal.choices);
        this.plot = new uPlot({
            width: 300, height: HEIGHT_MIN, legend: { show: false },
            padding: [6, 28, 0, 0],
            scales: { x: { time: false }, y: { range: rangeOf(list) } },
            axes: [
                { size: 26, values: (plot, ticks) => ticks.map((tick) => `${+tick.toFixed(6)} s`.replace("-", "−")), space: 90,
                  font: "12px system-ui, sans-serif", stroke: "#333", grid: { stroke: "#e8e8e8", width: 1 },
                  ticks: { size: 4 } },
                { size: AXIS_WIDTH, label: unit, labelSize: states ? 0 : 18, labelGap: 0,
                  font: "12px system-ui, sans-serif", labelFont: "12px system-ui, sans-serif", stroke: "#333",
                  grid: { stroke: "#e8e8e8", width: 1 }, ticks: { size: 4 }, space: 26,
                  values: (plot, ticks) => ticks.map((tick) => (states ? this.stateName(tick) : shortNumber(tick))),
                  ...(states ? { incrs: [1, 2, 5, 10] } : {}) },
            ],
            cursor: { sync: { key: "time" }, points: { show: false }, drag: { x: true, y: false, setScale: false } },
            series: [{}, ...list.map((series) => ({
                ...lineStyle(indexOf(series)), width: 1.5, spanGaps: true, points: { show: false },
                ...(series.signal.choices ? { paths: uPlot.paths.stepped({ align: 1 }) } : {}),
            }))],
            hooks: {
                draw: [(plot) => charts.drawMarks(plot)],
                setSelect: [(plot) => {
                    if (plot.select.width > 4) {
                        const [left, right] = [plot.select.left, plot.select.left + plot.select.width];
                        charts.onZoom(plot.posToVal(left, "x") * 1e9, plot.posToVal(right, "x") * 1e9);
                    }
                    plot.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
                }],
            },
        }, null, this.body);
        this.plot.over.addEventListener("click", (event) => {
            const time_ns = this.plot.posToVal(event.offsetX, "x") * 1e9;
            charts.onMark(charts.cursorFor(time_ns), time_ns);
        });
    }

    stateName(value) {
        const name = nameOf(this.list[0].signal, value);
        if (name === undefined) {
            return this.plot.data.slice(1).some((points) => points.includes(value)) ? String(value) : "";
        }
        return name.length > NAME_LENGTH ? `${name.slice(0, NAME_LENGTH - 1)}…` : name; // the legend has all of it
    }

    addToLegend(charts, series, style) {
        const item = document.createElement("li");
        const swatch = document.createElement("span");
        swatch.className = "swatch";
        swatch.style.borderTopColor = style.stroke;
        swatch.style.borderTopStyle = style.dash.length === 0 ? "solid" : style.dash[0] > 3 ? "dashed" : "dotted";
        const name = document.createElement("span");
        name.textContent = charts.shortName(series);
        name.title = `${series.name}: ${series.signal.comment}`;
        const value = document.createElement("output");
        item.append(swatch, name, value);
        this.legend.append(item);
        return value;
    }
}

export class Charts {
    /** onZoom(from_ns, to_ns), onMark("A" or "B", time_ns): the user has asked for it in a plot. */
    constructor(root, { onZoom, onMark }) {
        this.root = root;
        this.onZoom = onZoom;
        this.onMark = onMark;
        this.plots = [];
        this.list = [];
        this.marks = {};
        this.stimuli_s = []; // times at which something was done
        this.onDraw = () => {}; // (plot, list): more to draw into a plot
        this.version = 0; // of what is drawn beside the signals
        new ResizeObserver(() => this.resize()).observe(root);
    }

    /** Shows these signals, signals of one unit together, in the order in which the units come. */
    show(list) {
        this.plots.forEach((plot) => {
            plot.plot.destroy();
            plot.element.remove();
        });
        this.list = list;
        const groups = new Map();
        for (const series of list) {
            const key = series.signal.choices ? series.name : series.signal.unit;
            groups.set(key, [...(groups.get(key) || []), series]);
        }
        this.plots = [...groups.values()].map((group) => new Plot(
            this, group[0].signal.unit, group, (series) => group.indexOf(series)));
        this.resize();
    }

    /** The name of a signal, with the name of its message where another one shown is called the same. */
    shortName(series) {
        const same = this.list.filter((other) => other.signal.name === series.signal.name);
        return same.length > 1 ? series.name : series.signal.name;
    }

    /** The cursor that a click sets: first A, then B, then the nearer one. */
    cursorFor(time_ns) {
        const { A, B } = this.marks;
        if (A === undefined || B === undefined) {
            return A === undefined ? "A" : "B";
        }
        return Math.abs(time_ns - A) <= Math.abs(time_ns - B) ? "A" : "B";
    }

    setMark(name, time_ns) {
        this.marks[name] = time_ns;
        this.version += 1;
    }

    resize() {
        this.version += 1;
        const width = this.root.clientWidth;
        const legends = this.plots.reduce((sum, plot) => sum + plot.legend.offsetHeight, 0);
        const free = this.root.clientHeight - legends - 4 * this.plots.length;
        const height = ONE_COLUMN.matches ? HEIGHT_STACKED
            : Math.max(HEIGHT_MIN, Math.floor(free / Math.max(1, this.plots.length)));
        if (width > 0) {
            this.plots.forEach((plot) => plot.plot.setSize({ width, height }));
        }
    }

    draw(from_ns, to_ns, value_ns) {
        for (const { plot, list, values } of this.plots) {
            const columns = Math.max(50, Math.round(plot.bbox.width / devicePixelRatio));
            const grid = gridOf(from_ns, to_ns, columns);
            plot.batch(() => {
                plot.setData([grid.time_s, ...list.map((series) => reduced(series, grid))], false);
                plot.setScale("x", { min: from_ns / 1e9, max: to_ns / 1e9 });
            });
            list.forEach((series, index) => {
                const text = textOf(series.signal, series.at(value_ns));
                values[index].textContent = `${text} ${series.signal.choices ? "" : series.signal.unit}`;
            });
        }
    }

    /** Cursors, trigger and what was done as vertical lines; acts that come at once share a line. */
    drawMarks(plot) {
        this.onDraw(plot, this.plots.find((each) => each.plot === plot)?.list ?? []);
        const acts = new Map();
        this.stimuli_s.forEach((time_s, index) => {
            acts.set(time_s, [...(acts.get(time_s) || []), index + 1]);
        });
        for (const [time_s, numbers] of acts) {
            const [first, last] = [numbers[0], numbers[numbers.length - 1]];
            drawMark(plot, time_s, first === last ? `${first}` : `${first}–${last}`, STIMULUS_COLOUR, [2, 2]);
        }
        for (const [name, time_ns] of Object.entries(this.marks)) {
            if (time_ns !== undefined) {
                drawMark(plot, time_ns / 1e9, name, "#444", name === "A" ? [] : name === "B" ? [6, 3] : [1, 3]);
            }
        }
    }
}

/** A vertical line with a name, if its time is in the plot. */
function drawMark(plot, time_s, name, colour, dash) {
    if (time_s < plot.scales.x.min || time_s > plot.scales.x.max) {
        return;
    }
    const x = Math.round(plot.valToPos(time_s, "x", true)) + 0.5;
    const context = plot.ctx;
    context.save();
    context.strokeStyle = context.fillStyle = colour;
    context.lineWidth = devicePixelRatio;
    context.setLineDash(dash);
    context.beginPath();
    context.moveTo(x, plot.bbox.top);
    context.lineTo(x, plot.bbox.top + plot.bbox.height);
    context.stroke();
    context.font = `${11 * devicePixelRatio}px system-ui, sans-serif`;
    context.textAlign = "left";
    context.fillText(name, x + 3 * devicePixelRatio, plot.bbox.top + 11 * devicePixelRatio);
    context.restore();
}

/** The signals from one time to another as CSV: a row for each time at which one of them came, empty where another
 *  did not. Times in seconds, values in the units of the head, or by their names. */
export function csvOf(list, from_ns, to_ns) {
    const head = ["time_s", ...list.map((series) => series.name + (series.signal.unit ? ` (${series.signal.unit})` : ""))];
    const rows = new Map();
    list.forEach((series, column) => {
        for (let i = series.indexAt(from_ns); i < series.size && series.time[i] <= to_ns; i++) {
            if (!rows.has(series.time[i])) {
                rows.set(series.time[i], new Array(list.length).fill(""));
            }
            const digits = Math.max(decimalsOf(series.signal), 6);
            rows.get(series.time[i])[column] = nameOf(series.signal, series.value[i])
                ?? String(+series.value[i].toFixed(digits));
        }
    });
    const quoted = (text) => (/[",]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text);
    const lines = [...rows.entries()].sort((a, b) => a[0] - b[0])
        .map(([time_ns, values]) => [(time_ns / 1e9).toFixed(9), ...values].join(","));
    return [head.map(quoted).join(","), ...lines].join("\n") + "\n";
}
