// The abandoned branch of a run, beside the present one: its signals, dashed, in the plots of the page.

const WIDTH = 1;

export class OtherBranch {
    constructor(page) {
        this.page = page;
        this.series = new Map(); // by name: { time_ns, value }
        page.charts.onDraw = (plot, list) => this.draw(plot, list);
    }

    /** Keeps what the page has from a time on, before it forgets that. */
    keep(fromNs) {
        this.series.clear();
        for (const [name, series] of this.page.store.series) {
            const from = series.indexAt(fromNs);
            this.series.set(name, { time_ns: series.time.slice(from, series.size),
                                    value: series.value.slice(from, series.size) });
        }
    }

    draw(plot, list) {
        const context = plot.ctx;
        context.save();
        context.beginPath();
        context.rect(plot.bbox.left, plot.bbox.top, plot.bbox.width, plot.bbox.height);
        context.clip();
        context.lineWidth = WIDTH * devicePixelRatio;
        context.globalAlpha = 0.75;
        context.setLineDash([2 * devicePixelRatio, 3 * devicePixelRatio]);
        list.forEach((series, index) => {
            const other = this.series.get(series.name);
            if (other !== undefined && other.time_ns.length > 0) {
                context.strokeStyle = plot.series[index + 1].stroke(plot, index + 1);
                this.trace(plot, other);
            }
        });
        context.restore();
    }

    trace(plot, { time_ns: time, value }) {
        const { min, max } = plot.scales.x;
        plot.ctx.beginPath();
        for (let i = 0; i < time.length; i++) {
            const at = time[i] / 1e9;
            if (at >= min && at <= max) {
                plot.ctx.lineTo(plot.valToPos(at, "x", true), plot.valToPos(value[i], "y", true));
            }
        }
        plot.ctx.stroke();
    }
}
