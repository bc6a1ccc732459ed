// The packed block of salient.tab.file: module, machines, databases.

/** { build, version, faults, parameter_choices, data_ids, variables, databases, machines, module, images by machine } */
export async function readData(text) {
    const packed = Uint8Array.from(atob(text), (each) => each.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
    const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
    const textBytes = new DataView(bytes.buffer).getUint32(0, true);
    const data = JSON.parse(new TextDecoder().decode(bytes.subarray(4, 4 + textBytes)));
    let at = 4 + textBytes;
    const [module, ...images] = data.files.map((size) => bytes.subarray(at, at += size));
    data.maps.forEach(([start, count], i) => restoreDoubles(images[i].subarray(start, start + 8 * count)));
    for (const { machine: { flux_map: map } } of Object.values(data.machines)) {
        map.flux_linkage_Wb = map.current_A.map((_, row) => map.flux_linkage_Wb.map((column) => column[row]));
    }
    return { ...data, module, images: Object.fromEntries(Object.keys(data.machines).map((name, i) => [name, images[i]])) };
}

/** Undoes _transposed of salient.tab.file in place. */
function restoreDoubles(bytes) {
    const count = bytes.length / 8;
    const numbers = new BigUint64Array(count);
    const restored = new Uint8Array(numbers.buffer);
    bytes.forEach((each, i) => {
        restored[i % count * 8 + Math.floor(i / count)] = each;
    });
    for (let i = 1; i < count; i++) {
        numbers[i] += numbers[i - 1]; // modulo 2^64
    }
    bytes.set(restored);
}

/** Databases with the factors and ranges of a machine. */
export function databasesOf(data, machine) {
    const databases = structuredClone(data.databases);
    for (const [message, signal, factor, offset, minimum, maximum] of data.machines[machine].signals) {
        Object.assign(databases[message].signals[signal], { factor, offset, minimum, maximum });
    }
    return databases;
}
