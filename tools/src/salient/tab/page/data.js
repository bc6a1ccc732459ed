// The packed block of salient.tab.file: module, machines, databases.

/** { build, version, faults, data_ids, databases, machines, module, images by machine } */
export async function readData(text) {
    const packed = Uint8Array.from(atob(text), (each) => each.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
    const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
    const textBytes = new DataView(bytes.buffer).getUint32(0, true);
    const data = JSON.parse(new TextDecoder().decode(bytes.subarray(4, 4 + textBytes)));
    let at = 4 + textBytes;
    const [module, ...images] = data.files.map((size) => bytes.subarray(at, at += size));
    return { ...data, module, images: Object.fromEntries(Object.keys(data.machines).map((name, i) => [name, images[i]])) };
}

/** Databases with the factors and ranges of a machine. */
export function databasesOf(data, machine) {
    const databases = structuredClone(data.databases);
    for (const [message, signal, factor, offset, minimum, maximum] of data.machines[machine].signals) {
        Object.assign(databases[message].signals[signal], { factor, offset, minimum, maximum });
    }
    return databases;
}
