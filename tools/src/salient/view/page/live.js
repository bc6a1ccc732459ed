// The source of a page that a server serves: frames of a bus or a log over a WebSocket.

const EXPECTED_HEADER_BYTES = 16;
const LATENCIES_MAX = 100_000; // half an hour

export class LiveSource {
    constructor(address) {
        this.address = address;
        this.answers = new Map();
        this.next = 1;
        this.takeFrames = () => {};
        this.takeNotice = () => {};
        /** Wall time from the reception of the newest frame to its display, in ms; one for each batch. */
        this.latencies_ms = [];
        this.received_ms = 0;
    }

    onFrames(callback) {
        this.takeFrames = callback;
    }

    onNotice(callback) {
        this.takeNotice = callback;
    }

    open() {
        return new Promise((resolve, reject) => {
            const socket = new WebSocket(this.address);
            socket.binaryType = "arraybuffer";
            socket.onmessage = (event) => {
                if (typeof event.data === "string") {
                    this.takeText(JSON.parse(event.data), resolve);
                } else {
                    this.takeBinary(event.data);
                }
            };
            socket.onclose = (event) => {
                const refused = "The server refused this page or is not there: open the link that it has printed.";
                reject(new Error(event.reason || refused));
                const ended = event.reason || "The connection to the server has ended.";
                this.takeNotice({ ended: true, lease: "free", text: ended });
                this.answers.forEach((answer) => answer({ ok: false, message: "the connection has ended" }));
            };
            this.socket = socket;
        });
    }

    takeText(message, resolve) {
        if (message.info) {
            resolve(message.info);
        } else if (message.notice) {
            this.takeNotice(message.notice);
        } else if (this.answers.has(message.n)) {
            const { n, ...answer } = message;
            this.answers.get(n)(answer);
            this.answers.delete(n);
        }
    }

    takeBinary(buffer) {
        const header = new DataView(buffer);
        const count = header.getUint32(0, true);
        let at = EXPECTED_HEADER_BYTES;
        const column = (Type, perFrame) => {
            const array = new Type(buffer, at, count * perFrame);
            at += array.byteLength;
            return array;
        };
        const batch = { count, lost: header.getUint32(4, true) };
        this.received_ms = header.getFloat64(8, true);
        batch.time_ns = column(Float64Array, 1);
        batch.id = column(Uint32Array, 1);
        batch.data = column(Uint8Array, 8);
        batch.length = column(Uint8Array, 1);
        this.takeFrames(batch);
    }

    shown(time_ns) {
        if (this.received_ms) {
            this.latencies_ms.push(performance.timeOrigin + performance.now() - this.received_ms);
            this.received_ms = 0;
            if (this.latencies_ms.length > LATENCIES_MAX) {
                this.latencies_ms.shift();
            }
        }
        this.send({ shown: time_ns });
    }

    command(name, args) {
        const n = this.next++;
        return new Promise((resolve) => {
            this.answers.set(n, resolve);
            if (!this.send({ n, name, args })) {
                resolve({ ok: false, message: "there is no connection" });
            }
        });
    }

    send(message) {
        const open = this.socket && this.socket.readyState === WebSocket.OPEN;
        if (open) {
            this.socket.send(JSON.stringify(message));
        }
        return open;
    }
}
