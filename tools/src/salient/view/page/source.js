// What the page knows of the world: a source of CAN frames that takes commands. Three exist: a drive on a bus or a log,
// behind a WebSocket (live.js), and the drive in the tab. The page is started with one of them:
//
//     import { startPage } from "./app.js";
//     startPage(new LiveSource(...));
//
// /** A source has these members. */
// interface Source {
//     /** Connects; the info describes what follows. Rejects with an Error whose message is for the user. */
//     open(): Promise<Info>;
//
//     /** Registers the one receiver of frames; called before open(). A batch has all frames since the last one, in the
//         order of the bus. The source calls it at most once for each shown(). */
//     onFrames(callback: (batch: Batch) => void): void;
//
//     /** Registers the one receiver of notices; called before open(). */
//     onNotice(callback: (notice: Notice) => void): void;
//
//     /** The page has drawn everything up to this time; called at every display frame, and not while the page sleeps.
//         A source that moves time by itself may take it as its clock; a server takes it as a sign of life. */
//     shown(time_ns: number): void;
//
//     /** Carries out a command of COMMANDS. Never rejects: a refusal is { ok: false, message }. */
//     command(name: string, args: object): Promise<{ ok: boolean, message: string, value?: any }>;
// }
//
// interface Batch {
//     count: number;
//     time_ns: Float64Array;   // virtual time, or the drive's own where the bus has none
//     id: Uint32Array;         // as can_id of Linux: bit 31 set for a 29-bit identifier
//     length: Uint8Array;      // 0 to 8
//     data: Uint8Array;        // 8 per frame, unused ones 0
//     lost: number;            // frames that were dropped before this batch because the page did not take them
//     rewound?: boolean;       // the frames begin again at an earlier time: what was shown from there on is void
// }
//
// interface Notice {           // every member may be missing: unchanged
//     lease?: "free" | "yours" | "other";   // who commands
//     text?: string;           // one line to show
//     ended?: boolean;         // no more frames will come
//     malformed?: number;      // messages of pages that were dropped, so far
//     traffic?: Traffic;       // of the last half second, of a log of all its time; null before the first
// }
//
// interface Traffic {
//     load: number; peak: number;         // parts of the time; peak: the greatest of 100 ms so far
//     frames: number; errors: number; duration_s: number;
//     nodes: { name: string, share: number, silent: boolean, messages: MessageTraffic[] }[];
//     unknown: MessageTraffic[]; unknown_count: number;   // the most frequent identifiers of no database; of how many
//     events: { time_ns: number, text: string }[];        // what went missing and came back, the latest ones
// }
//
// interface MessageTraffic {
//     id: string; name: string; frames: number; state: "" | "missing" | "never" | "wrong length";
//     cycle_ms: number | null; expected_ms: number | null; shortest_ms: number; longest_ms: number;
// }
//
// interface Info {
//     kind: "live" | "replay" | "tab";
//     title: string;           // the bus, the file, the build
//     databases: Message[];    // of drive, test bench and other nodes
//     database_hash: number;   // of the drive's DBC above, as DRIVE_IDENTITY.dbc_hash reports it
//     machine: Machine;
//     faults: FaultKind[];     // that the test bench knows; empty without one
//     parameter_choices: { [parameter: string]: string[] };   // names of the values 0, 1, ... of those that select something
//     commands: string[];      // names of COMMANDS that this source carries out
//     build: string;           // version, and hash of the build where there is one
//     period_ms: number;       // of the telemetry at the start, or 0 when unknown
//     start_ns?: number;       // of a replay: its first and last frame
//     end_ns?: number;
// }
//
// interface Message {
//     id: number;              // as Batch.id
//     name: string; node: string; length: number; comment: string;   // node: the sender
//     may_be_longer?: boolean; // frames of this length or more count, else of this one
//     group?: number;          // parameter group of J1939, from any source; else frames of `id` count
//     signals: Signal[];
// }
//
// interface Signal {
//     name: string; unit: string; comment: string;
//     start: number; length: number;      // little endian: least significant bit and number of bits
//     reversed?: boolean;                 // in the eight bytes in opposite order: a big-endian signal
//     signed: boolean; float: boolean;    // float: IEEE 754, of 16, 32 or 64 bits
//     factor: number; offset: number; minimum: number | null; maximum: number | null;
//     choices: { [number: string]: string } | null;
//     multiplexer: boolean;               // its value selects the signals of its message
//     multiplexed: number[] | null;       // values of the multiplexer with which this signal is there; null: always
//     selector?: string;                  // that multiplexer
// }
//
// interface Machine {
//     name: string; stator_poles: number; rotor_poles: number; phases: number;
//     resistance_ohm: number; supply_voltage_V: number;
//     current_peak_A: number; torque_rated_Nm: number; torque_peak_Nm: number;
//     speed_base_rpm: number; speed_max_rpm: number;
//     // flux_linkage_Wb[i][j] at current_A[i] and angle_deg[j], mechanical from aligned (0) over one rotor pole pitch
//     flux_map: { angle_deg: number[], current_A: number[], flux_linkage_Wb: number[][] };
// }
//
// interface FaultKind {
//     name: string; text: string; phase: boolean; leg: boolean;
//     attribute: null | { name: string, unit: string, minimum: number, maximum: number, choices: string[] | null };
// }

/** Commands, their arguments, and the value of the answer where there is one. */
export const COMMANDS = {
    take: {}, // the lease of the commanding page; a source with one page only has it always and grants it
    release: {},
    speed_reference: { rpm: "number" }, // run in speed mode: arms the drive where needed and repeats the command
    torque_reference: { Nm: "number" }, // run in torque mode
    stop: {}, // ramp to zero
    off: {}, // open all switches now
    clear_fault: {},
    load_torque: { Nm: "number" },
    truth_period: { us: "number" }, // of the true state that the test bench sends
    fault: { kind: "string", phase: "string?", leg: "string?", value: "any?", duration_s: "number?" },
    end_fault: { kind: "string", phase: "string?", leg: "string?" }, // one of any client
    end_faults: {}, // all that this page has begun
    parameters: {}, // -> [{ name, unit, minimum, maximum, default, value, fraction_bits }]
    set_parameters: { values: "object" }, // by name, as one set: all or none; numbers, or names of parameter_choices
    save_parameters: {}, // to the memory of the drive
    fault_trace: {}, // -> { time_s[], current_A[][phase], bus_voltage_V[], rotor_angle_deg[], speed_rpm[],
    //                       torque_reference_Nm[], upper_duty[][phase], lower_duty[][phase] }
    fault_log: {}, // -> [{ number, start, time_s, fault, checks[], state, speed_rpm, bus_voltage_V, current_max_A,
    //                      torque_reference_Nm }]
    scope_names: {}, // -> [short name of a variable of the drive]
    scope_arm: { signals: "string[]", trigger: "string?", before: "number?", divider: "number?" },
    scope_trigger: {}, // now
    scope_read: {}, // -> { state: "waits" | "reads" | "complete", and of a complete buffer title, time_s[],
    //                     signals: [{ name, unit, values[], choices }] }; "reads" is to be asked on
    pause: {}, // a source that moves time: time stands still, goes on, takes one step, goes back
    resume: {},
    step: { s: "number" },
    rewind: { time_ns: "number" },
};
