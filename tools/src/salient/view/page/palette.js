// Colours of Okabe and Ito, in an order in which the first ones differ most to any eye; without the yellow, too light on
// white. The phases' are told apart by any eye; E and F are not of Okabe and Ito.

export const COLOURS = ["#0072b2", "#d55e00", "#000000", "#56b4e9", "#009e73", "#e69f00", "#cc79a7"];
export const PHASE_COLOURS = ["#0072b2", "#d55e00", "#000000", "#56b4e9", "#7711dd", "#996655"];
export const PHASE_NAMES = ["A", "B", "C", "D", "E", "F"];

/** Colour and dash of the n-th signal of a plot: the dash tells signals of the same colour apart. */
export function lineStyle(index) {
    const dashes = [[], [7, 4], [2, 3]];
    return { stroke: COLOURS[index % COLOURS.length],
             dash: dashes[Math.floor(index / COLOURS.length) % dashes.length] };
}

/** "#rrggbb" with an opacity. */
export function withOpacity(colour, opacity) {
    const part = (from) => parseInt(colour.slice(from, from + 2), 16);
    return `rgba(${part(1)}, ${part(3)}, ${part(5)}, ${opacity})`;
}
