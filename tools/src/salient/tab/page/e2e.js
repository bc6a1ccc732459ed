// End-to-end protection of frames as AUTOSAR E2E profile 5, and the checksum of a set of parameters.

/** Bytes before the data of a protected frame: checksum, low byte first, and counter. */
export const HEADER_BYTES = 3;

/** CRC-16/CCITT-FALSE over a frame from its counter on, and then its data ID. */
function checksum(dataId, bytes) {
    let crc = 0xffff;
    for (const byte of [...bytes, dataId & 0xff, dataId >> 8]) {
        crc ^= byte << 8;
        for (let bit = 0; bit < 8; bit++) {
            crc = ((crc << 1) ^ (crc & 0x8000 ? 0x1021 : 0)) & 0xffff;
        }
    }
    return crc;
}

/** Writes checksum and counter into a frame. */
export function protect(dataId, counter, data) {
    data[2] = counter & 0xff;
    const crc = checksum(dataId, data.subarray(2));
    data[0] = crc & 0xff;
    data[1] = crc >> 8;
}

/** CRC-32 of IEEE 802.3, continued from the CRC of the bytes before. */
export function crc32(bytes, before = 0) {
    let crc = ~before >>> 0;
    for (const byte of bytes) {
        crc ^= byte;
        for (let bit = 0; bit < 8; bit++) {
            crc = (crc >>> 1) ^ (crc & 1 ? 0xedb88320 : 0);
        }
    }
    return ~crc >>> 0;
}
