# Written by python -m salient.bench.stubs from the CAN databases, firmware/storage/parameters.def and tools/loads.
# ruff: noqa
from collections.abc import Sequence
from typing import Any, Literal, overload

from salient.bench.bench import Bench as _Bench
from salient.bench.drive import Drive as _Drive
from salient.bench.drive import Parameters as _Parameters
from salient.bench.rig import Fault as Fault
from salient.bench.rig import Rig as _Rig
from salient.bus.signals import Signal as Signal
from salient.bus.signals import SignalTable

LoadProfile = Literal[
    "compressor_one_cylinder",
    "compressor_two_cylinders",
]

ParameterName = Literal[
    "controller",
    "speed_ramp_rpm_s",
    "torque_max_Nm",
    "current_limit_A",
    "current_trip_A",
    "over_voltage_V",
    "under_voltage_V",
    "over_speed_rpm",
    "command_timeout_ms",
    "turn_on_angle_deg",
    "turn_off_angle_deg",
    "outgoing_off_angle_deg",
    "hand_over_angle_deg",
    "torque_band_inner_Nm",
    "torque_band_outer_Nm",
    "speed_kp",
    "speed_ki",
    "smc_k",
    "smc_epsilon",
    "smc_delta",
    "observer_bandwidth_rad_s",
    "bp_mode",
    "bp_seed",
    "bp_learning_rate",
    "bp_momentum",
    "bp_error_scale_Nm",
    "bp_kp_max",
    "bp_ki_max",
    "bp_kd_max",
    "bp_assist_band_Nm",
    "inertia_kg_m2",
    "friction_Nm_s",
    "resistance_ohm",
    "load_source",
    "observer_scheduling",
    "observer_transient_rad_s",
    "observer_steady_rad_s",
    "pulses_per_period",
    "torque_sharing",
    "share_on_angle_deg",
    "share_off_angle_deg",
    "share_on_advance_deg",
    "share_off_advance_deg",
    "torque_reserve_Nm",
    "flux_observer_gain",
    "angle_adaptation",
    "angle_adaptation_1_s",
    "observer_moving_rad_s",
    "periodic_load",
    "torque_slew_rate_Nm_s",
    "telemetry_period_ms",
    "telemetry_slow_period_ms",
    "winding_current_A",
    "winding_time_constant_s",
    "switch_current_A",
    "winding_limit_C",
    "inverter_limit_C",
    "degraded_running",
    "table_scale",
    "protocol",
    "position_min_rev",
    "position_max_rev",
    "position_gain_1_s",
    "position_speed_rpm",
    "position_accel_rpm_s",
    "position_decel_rpm_s",
    "position_jerk_rpm_s2",
    "following_error_deg",
    "position_window_deg",
    "position_cycle_ms",
    "homing_method",
    "homing_speed_rpm",
    "homing_torque_Nm",
]

TelemetryName = Literal[
    "time_us",
    "DRIVE_STATUS.time_us",
    "state",
    "DRIVE_STATUS.state",
    "mode",
    "DRIVE_STATUS.mode",
    "controller",
    "DRIVE_STATUS.controller",
    "speed_limited",
    "DRIVE_STATUS.speed_limited",
    "fault",
    "DRIVE_STATUS.fault",
    "voltage_saturated",
    "DRIVE_STATUS.voltage_saturated",
    "start_inhibited_by",
    "DRIVE_STATUS.start_inhibited_by",
    "single_pulse",
    "DRIVE_STATUS.single_pulse",
    "cycle",
    "DRIVE_STATUS.cycle",
    "speed_rpm",
    "DRIVE_MOTION.speed_rpm",
    "speed_reference_rpm",
    "DRIVE_MOTION.speed_reference_rpm",
    "rotor_angle_deg",
    "DRIVE_MOTION.rotor_angle_deg",
    "torque_reference_Nm",
    "DRIVE_TORQUE.torque_reference_Nm",
    "torque_estimate_Nm",
    "DRIVE_TORQUE.torque_estimate_Nm",
    "load_torque_estimate_Nm",
    "DRIVE_TORQUE.load_torque_estimate_Nm",
    "bus_voltage_V",
    "DRIVE_TORQUE.bus_voltage_V",
    "current_a_A",
    "DRIVE_CURRENTS.current_a_A",
    "current_b_A",
    "DRIVE_CURRENTS.current_b_A",
    "current_c_A",
    "DRIVE_CURRENTS.current_c_A",
    "current_d_A",
    "DRIVE_CURRENTS.current_d_A",
    "kp_per_Nm",
    "DRIVE_BP_PID.kp_per_Nm",
    "ki_per_Nm",
    "DRIVE_BP_PID.ki_per_Nm",
    "kd_per_Nm",
    "DRIVE_BP_PID.kd_per_Nm",
    "duty",
    "DRIVE_BP_PID.duty",
    "DRIVE_FAULT_CAUSE.time_us",
    "DRIVE_FAULT_CAUSE.fault",
    "DRIVE_FAULT_CAUSE.state",
    "checks",
    "DRIVE_FAULT_CAUSE.checks",
    "DRIVE_FAULT_SNAPSHOT.speed_rpm",
    "DRIVE_FAULT_SNAPSHOT.bus_voltage_V",
    "current_max_A",
    "DRIVE_FAULT_SNAPSHOT.current_max_A",
    "DRIVE_FAULT_SNAPSHOT.torque_reference_Nm",
    "wrong_length",
    "DRIVE_COMMAND_COUNTERS.wrong_length",
    "wrong_checksum",
    "DRIVE_COMMAND_COUNTERS.wrong_checksum",
    "wrong_counter",
    "DRIVE_COMMAND_COUNTERS.wrong_counter",
    "out_of_range",
    "DRIVE_COMMAND_COUNTERS.out_of_range",
    "unknown_frame",
    "DRIVE_BUS_COUNTERS.unknown_frame",
    "receive_overflow",
    "DRIVE_BUS_COUNTERS.receive_overflow",
    "telemetry_dropped",
    "DRIVE_BUS_COUNTERS.telemetry_dropped",
    "command_accepted",
    "DRIVE_BUS_COUNTERS.command_accepted",
    "misalignment_deg",
    "DRIVE_ADAPTATION.misalignment_deg",
    "torque_missing_Nm",
    "DRIVE_ADAPTATION.torque_missing_Nm",
    "observer_bandwidth_rad_s",
    "DRIVE_ADAPTATION.observer_bandwidth_rad_s",
    "used_us",
    "DRIVE_PROCESSOR.used_us",
    "worst_us",
    "DRIVE_PROCESSOR.worst_us",
    "available_us",
    "DRIVE_PROCESSOR.available_us",
    "late_interrupts",
    "DRIVE_PROCESSOR.late_interrupts",
    "over_current",
    "DRIVE_FAULT_MASK.over_current",
    "over_voltage",
    "DRIVE_FAULT_MASK.over_voltage",
    "under_voltage",
    "DRIVE_FAULT_MASK.under_voltage",
    "over_speed",
    "DRIVE_FAULT_MASK.over_speed",
    "encoder",
    "DRIVE_FAULT_MASK.encoder",
    "command_timeout",
    "DRIVE_FAULT_MASK.command_timeout",
    "interrupt_overrun",
    "DRIVE_FAULT_MASK.interrupt_overrun",
    "command_error",
    "DRIVE_FAULT_MASK.command_error",
    "identifier_conflict",
    "DRIVE_FAULT_MASK.identifier_conflict",
    "parameter_memory",
    "DRIVE_FAULT_MASK.parameter_memory",
    "hardware_over_current",
    "DRIVE_FAULT_MASK.hardware_over_current",
    "sto",
    "DRIVE_FAULT_MASK.sto",
    "sto_discrepancy",
    "DRIVE_FAULT_MASK.sto_discrepancy",
    "stall",
    "DRIVE_FAULT_MASK.stall",
    "current_sensor",
    "DRIVE_FAULT_MASK.current_sensor",
    "phase_open",
    "DRIVE_FAULT_MASK.phase_open",
    "phase_shorted",
    "DRIVE_FAULT_MASK.phase_shorted",
    "encoder_angle",
    "DRIVE_FAULT_MASK.encoder_angle",
    "winding_overload",
    "DRIVE_FAULT_MASK.winding_overload",
    "inverter_overload",
    "DRIVE_FAULT_MASK.inverter_overload",
    "temperature_sensor",
    "DRIVE_FAULT_MASK.temperature_sensor",
    "watchdog",
    "DRIVE_FAULT_MASK.watchdog",
    "memory",
    "DRIVE_FAULT_MASK.memory",
    "code",
    "DRIVE_FAULT_MASK.code",
    "clock",
    "DRIVE_FAULT_MASK.clock",
    "DRIVE_DEFERRED.used_us",
    "DRIVE_DEFERRED.worst_us",
    "skipped_periods",
    "DRIVE_DEFERRED.skipped_periods",
    "bus_state",
    "DRIVE_BUS_STATE.bus_state",
    "receive_error_counter",
    "DRIVE_BUS_STATE.receive_error_counter",
    "transmit_error_counter",
    "DRIVE_BUS_STATE.transmit_error_counter",
    "bus_off_count",
    "DRIVE_BUS_STATE.bus_off_count",
    "foreign_identifier_count",
    "DRIVE_BUS_STATE.foreign_identifier_count",
    "challenge",
    "DRIVE_ARMING.challenge",
    "attempt",
    "DRIVE_ARMING.attempt",
    "armed",
    "DRIVE_ARMING.armed",
    "configuring",
    "DRIVE_ARMING.configuring",
    "refused",
    "DRIVE_ARMING.refused",
    "run_unarmed",
    "DRIVE_ARMING.run_unarmed",
    "over_current_break",
    "DRIVE_GATES.over_current_break",
    "not_renewed_break",
    "DRIVE_GATES.not_renewed_break",
    "sto_1",
    "DRIVE_GATES.sto_1",
    "sto_2",
    "DRIVE_GATES.sto_2",
    "phase_a",
    "DRIVE_PHASE_FAULT.phase_a",
    "phase_b",
    "DRIVE_PHASE_FAULT.phase_b",
    "phase_c",
    "DRIVE_PHASE_FAULT.phase_c",
    "phase_d",
    "DRIVE_PHASE_FAULT.phase_d",
    "winding_load",
    "DRIVE_THERMAL.winding_load",
    "switch_load",
    "DRIVE_THERMAL.switch_load",
    "torque_limit_Nm",
    "DRIVE_THERMAL.torque_limit_Nm",
    "winding_temperature_C",
    "DRIVE_THERMAL.winding_temperature_C",
    "inverter_temperature_C",
    "DRIVE_THERMAL.inverter_temperature_C",
    "winding_sensor_a",
    "DRIVE_SELF_TEST.winding_sensor_a",
    "winding_sensor_b",
    "DRIVE_SELF_TEST.winding_sensor_b",
    "winding_sensor_c",
    "DRIVE_SELF_TEST.winding_sensor_c",
    "winding_sensor_d",
    "DRIVE_SELF_TEST.winding_sensor_d",
    "inverter_sensor_a",
    "DRIVE_SELF_TEST.inverter_sensor_a",
    "inverter_sensor_b",
    "DRIVE_SELF_TEST.inverter_sensor_b",
    "inverter_sensor_c",
    "DRIVE_SELF_TEST.inverter_sensor_c",
    "inverter_sensor_d",
    "DRIVE_SELF_TEST.inverter_sensor_d",
    "limits",
    "DRIVE_SELF_TEST.limits",
    "constants",
    "DRIVE_SELF_TEST.constants",
    "fault_latch",
    "DRIVE_SELF_TEST.fault_latch",
    "stack",
    "DRIVE_SELF_TEST.stack",
    "registers",
    "DRIVE_SELF_TEST.registers",
    "DRIVE_SELF_TEST.code",
    "DRIVE_SELF_TEST.clock",
    "parameters",
    "DRIVE_SELF_TEST.parameters",
    "degraded",
    "DRIVE_DEGRADED.degraded",
    "lost_phase_a",
    "DRIVE_DEGRADED.lost_phase_a",
    "lost_phase_b",
    "DRIVE_DEGRADED.lost_phase_b",
    "lost_phase_c",
    "DRIVE_DEGRADED.lost_phase_c",
    "lost_phase_d",
    "DRIVE_DEGRADED.lost_phase_d",
    "torque_mean_Nm",
    "DRIVE_DEGRADED.torque_mean_Nm",
    "torque_least_Nm",
    "DRIVE_DEGRADED.torque_least_Nm",
    "torque_here_Nm",
    "DRIVE_DEGRADED.torque_here_Nm",
    "table_scale",
    "DRIVE_ESTIMATES.table_scale",
    "resistance_ohm",
    "DRIVE_ESTIMATES.resistance_ohm",
    "forward_Nm",
    "DRIVE_AVAILABLE_TORQUE.forward_Nm",
    "backward_Nm",
    "DRIVE_AVAILABLE_TORQUE.backward_Nm",
    "forward_limited_by",
    "DRIVE_AVAILABLE_TORQUE.forward_limited_by",
    "backward_limited_by",
    "DRIVE_AVAILABLE_TORQUE.backward_limited_by",
    "load_exceeds",
    "DRIVE_AVAILABLE_TORQUE.load_exceeds",
    "machine_hash",
    "DRIVE_MACHINE.machine_hash",
    "position_deg",
    "DRIVE_POSITION.position_deg",
    "following_error_deg",
    "DRIVE_POSITION.following_error_deg",
    "position_state",
    "DRIVE_POSITION.position_state",
    "homed",
    "DRIVE_POSITION.homed",
    "homing_failed",
    "DRIVE_POSITION.homing_failed",
    "target_limited",
    "DRIVE_POSITION.target_limited",
    "operation",
    "PARAMETER_RESPONSE.operation",
    "index",
    "PARAMETER_RESPONSE.index",
    "part",
    "PARAMETER_RESPONSE.part",
    "status",
    "PARAMETER_RESPONSE.status",
    "value",
    "PARAMETER_RESPONSE.value",
    "packet_low",
    "XCP_RESPONSE.packet_low",
    "packet_high",
    "XCP_RESPONSE.packet_high",
    "firmware_major",
    "DRIVE_IDENTITY.firmware_major",
    "firmware_minor",
    "DRIVE_IDENTITY.firmware_minor",
    "firmware_patch",
    "DRIVE_IDENTITY.firmware_patch",
    "dbc_hash",
    "DRIVE_IDENTITY.dbc_hash",
    "DRIVE_HEARTBEAT.state",
    "DRIVE_HEARTBEAT.fault",
    "DRIVE_HEARTBEAT.controller",
    "phases",
    "DRIVE_HEARTBEAT.phases",
    "control_rate_hz",
    "DRIVE_HEARTBEAT.control_rate_hz",
]

TruthName = Literal[
    "time_ns",
    "RIG_CLOCK.time_ns",
    "sequence",
    "RIG_CLOCK.sequence",
    "quantity",
    "RIG_SET_REPLY.quantity",
    "status",
    "RIG_SET_REPLY.status",
    "at_us",
    "RIG_SET_REPLY.at_us",
    "RIG_STAMP.time_ns",
    "subject",
    "RIG_STAMP.subject",
    "kind",
    "RIG_FAULT_REPLY.kind",
    "phase",
    "RIG_FAULT_REPLY.phase",
    "leg",
    "RIG_FAULT_REPLY.leg",
    "begins",
    "RIG_FAULT_REPLY.begins",
    "RIG_FAULT_REPLY.status",
    "RIG_FAULT_REPLY.at_us",
    "speed_rpm",
    "RIG_TRUTH_MOTION.speed_rpm",
    "torque_Nm",
    "RIG_TRUTH_MOTION.torque_Nm",
    "part",
    "RIG_TRUTH_CURRENTS.part",
    "current_a_A",
    "RIG_TRUTH_CURRENTS.current_a_A",
    "current_c_A",
    "RIG_TRUTH_CURRENTS.current_c_A",
    "current_e_A",
    "RIG_TRUTH_CURRENTS.current_e_A",
    "current_b_A",
    "RIG_TRUTH_CURRENTS.current_b_A",
    "current_d_A",
    "RIG_TRUTH_CURRENTS.current_d_A",
    "current_f_A",
    "RIG_TRUTH_CURRENTS.current_f_A",
    "RIG_TRUTH_BENCH.part",
    "rotor_angle_deg",
    "RIG_TRUTH_BENCH.rotor_angle_deg",
    "winding_temperature_C",
    "RIG_TRUTH_BENCH.winding_temperature_C",
    "inverter_temperature_C",
    "RIG_TRUTH_BENCH.inverter_temperature_C",
    "load_torque_Nm",
    "RIG_TRUTH_BENCH.load_torque_Nm",
    "bus_voltage_V",
    "RIG_TRUTH_BENCH.bus_voltage_V",
    "RIG_TRUTH_FAULT.kind",
    "RIG_TRUTH_FAULT.phase",
    "RIG_TRUTH_FAULT.leg",
    "present",
    "RIG_TRUTH_FAULT.present",
]

class Telemetry(SignalTable):
    def __getitem__(self, name: TelemetryName | str) -> Signal: ...

class Truth(SignalTable):
    def __getitem__(self, name: TruthName | str) -> Signal: ...

class Parameters(_Parameters):
    def __getitem__(self, name: ParameterName | str) -> float: ...
    def __setitem__(self, name: ParameterName | str, value: float) -> None: ...

class Drive(_Drive):
    parameters: Parameters
    @property
    def telemetry(self) -> Telemetry: ...

class Rig(_Rig):
    load_torque_Nm: float
    """-10000 to 10000 N m. Load torque on the shaft, positive against forward motion."""
    supply_voltage_V: float
    """0 to 2000 V. Voltage of the supply of the DC link."""
    encoder_fault: float
    """0 to 2. Fault of the encoder: frozen repeats the last count, jump adds half a revolution to the angle."""
    interrupt_time_us: float
    """0 to 10000 us. Execution time of the control interrupt, added to the time of a target whose instructions take time; triggers that come during it are missed."""
    current_sensor_gain: float
    """0 to 10. Gain of every current sensor; 1 is exact."""
    truth_period_us: float
    """0 to 1e+06 us. Period of the RIG_TRUTH frames; 0 switches them off."""
    current_noise_A: float
    """0 to 80 A. Standard deviation of the Gaussian noise of every current sensor; the noise sequence follows from the seed."""
    current_sensor_offset_A: float
    """-100 to 100 A. Offset of every current sensor, added after its gain; the ADC reads 0 below 0 A."""
    current_sensor_limit_A: float
    """0.1 to 8000 A. Saturation of every current sensor, after gain, offset and noise."""
    current_sensor_delay_us: float
    """0 to 8 us. Delay of every current sensor: a sample shows the current of that much earlier, from the next control period on, at most one control period."""
    encoder_eccentricity_deg: float
    """0 to 5 deg. Eccentricity of the encoder's code disc: the encoder reads angle + this * sin(angle)."""
    flux_linkage_gain: float
    """0.2 to 5. Flux linkage and torque of every phase at the same angle and current, relative to the machine file: scales all inductances. The currents continue unchanged, so the energy of the fields jumps."""
    resistance_gain: float
    """0.2 to 5. Resistance of every winding, relative to the machine file."""
    inertia_gain: float
    """0.2 to 5. Moment of inertia, relative to the machine file. The speed continues unchanged, so the energy of the rotor jumps."""
    friction_gain: float
    """0 to 5. Friction, relative to the machine file."""
    encoder_offset_deg: float
    """-5 to 5 deg. Mechanical angle added to the encoder's: a misaligned encoder or angle table."""
    minimum_pulse_ns: float
    """0 to 2000 ns. Shortest pulse or gap of a switch, from the next control period on; a shorter one is suppressed."""
    load_ramp_Nm_s: float
    """0 to 8e+06 N m/s. Rate at which load_torque_Nm changes from its present value to a new one, in steps of 20 us; 0: it changes at once. A new rate also acts on a ramp that is under way."""
    load_sine_amplitude_Nm: float
    """0 to 10000 N m. Amplitude of a sine that is added to load_torque_Nm, in steps of 20 us; its phase is 0 at the time at which the amplitude changes from 0."""
    load_sine_frequency_Hz: float
    """0.01 to 1000 Hz. Frequency of the sine; its phase continues when the frequency changes."""
    load_profile_Nm: float
    """-200 to 200 N m. Torque of the value 1 of the load profile, which is added to load_torque_Nm by rotor angle, in steps of 20 us."""
    held_speed_rpm: float
    """-83886.1 to 80000 r/min. Speed at which a dynamometer holds the shaft, whatever the torques; it accelerates the shaft to it by 10000 r/min/s. free, which is not-a-number in Python: the shaft is free again."""
    supply_ripple_frequency_Hz: float
    """1 to 5000 Hz. Frequency of the fault supply_ripple; a change begins the sine again."""
    sto_1: float
    """0 to 1. First line of safe torque off. The gates of all switches need both lines energised, whatever the firmware does."""
    sto_2: float
    """0 to 1. Second line of safe torque off."""
    frame_fault: float
    """0 to 4. Fault of single frames on the bus. lost: acknowledged, but dropped by its receivers, a frame of the drive by all clients, a frame of others by the drive. corrupted: one bit inverted for all nodes, so that an error frame and a retransmission follow. delayed: stays in its sender for frame_delay_us. duplicated: an error in the last bit, after which receivers have taken the frame and its sender repeats it."""
    frame_fault_per_mille: float
    """0 to 1000. Share of the frames of frame_fault_sender that have the fault, chosen by a random sequence that follows from the seed; retransmissions are not chosen."""
    frame_fault_sender: float
    """0 to 2. Whose frames have the fault: of the drives, of other nodes, or of all."""
    frame_delay_us: float
    """0 to 8e+06 us. Delay of frame_fault delayed."""
    bus_connection: float
    """0 to 1. Connection of the drive to the bus; disconnected, it is alone: no other node acknowledges its frames. Acts at the end of the present frame, as the next variable does."""
    transmit_error_counter: float
    """0 to 256. Sets the transmit error counter of the drive's CAN controller, once; 256 is bus-off."""
    babble_load_percent: float
    """0 to 100 %. Bus load of a babbling node, a further sender on the bus; 0 switches it off. With an identifier of the drive's telemetry it is a second sender of that."""
    babble_identifier: float
    """0 to 2047. Identifier of the babbling node's frames."""
    babble_length: float
    """0 to 8. Data bytes of the babbling node's frames, which are numbered by them."""
    drive_reset: float
    """0 to 1. 1 resets the drive: its switches open, its program starts again, its memory keeps its content; motor and load continue. Not available when instructions take time."""
    memory_cut_operation: float
    """0 to 1e+06. The power of the drive is lost at this operation of its non-volatile memory, 1 is the next programming of a word or erasure of a page, and returns at once, as a reset; 0: no loss."""
    memory_cut_kind: float
    """0 to 2. What that operation leaves: old the content before, torn a word of which some bits are programmed or a page of random bits, half a half-programmed word or a page of erased, old and partly erased words."""
    ambient_C: float
    """-50 to 150 C. Temperature of the surroundings of windings and inverter."""
    held_winding_C: float
    """-83886.1 to 250 C. Temperature at which every winding is held, at once and whatever its losses. free, which is not-a-number in Python: the windings follow their losses again, from there on."""
    held_inverter_C: float
    """-83886.1 to 250 C. As held_winding_C, of the switches of every phase."""
    def at(self, time_s: float) -> Rig: ...
    def set_load_profile(self, values: LoadProfile | str | Sequence[float]) -> None: ...
    @overload
    def fault(self, kind: Literal["winding_open"], *, phase: Literal["a", "b", "c", "d", "e", "f"], duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["switch_open"], *, phase: Literal["a", "b", "c", "d", "e", "f"], leg: Literal["high", "low"], duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["switch_shorted"], *, phase: Literal["a", "b", "c", "d", "e", "f"], leg: Literal["high", "low"], duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["diode_open"], *, phase: Literal["a", "b", "c", "d", "e", "f"], leg: Literal["high", "low"], duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["gate_supply_lost"], *, phase: Literal["a", "b", "c", "d", "e", "f"], duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["winding_shorted"], *, phase: Literal["a", "b", "c", "d", "e", "f"], turns_percent: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["winding_to_earth"], *, phase: Literal["a", "b", "c", "d", "e", "f"], resistance_ohm: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["current_sensor_open"], *, phase: Literal["a", "b", "c", "d", "e", "f"], duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["current_sensor_stuck"], *, phase: Literal["a", "b", "c", "d", "e", "f"], code: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["current_sensor_low_rail"], *, phase: Literal["a", "b", "c", "d", "e", "f"], duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["current_sensor_high_rail"], *, phase: Literal["a", "b", "c", "d", "e", "f"], duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["current_sensor_gain"], *, phase: Literal["a", "b", "c", "d", "e", "f"], gain: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["current_sensor_offset"], *, phase: Literal["a", "b", "c", "d", "e", "f"], offset_A: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["current_sensor_swapped"], *, phase: Literal["a", "b", "c", "d", "e", "f"], with_phase: Literal["a", "b", "c", "d", "e", "f"], duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["dc_link_sensor_open"], *, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["dc_link_sensor_stuck"], *, code: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["dc_link_sensor_low_rail"], *, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["dc_link_sensor_high_rail"], *, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["dc_link_sensor_gain"], *, gain: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["dc_link_sensor_offset"], *, offset_V: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["encoder_stuck"], *, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["encoder_jump"], *, angle_deg: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["encoder_lost_counts"], *, counts_per_turn: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["encoder_noise"], *, deviation_deg: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["encoder_reversed"], *, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["encoder_slip"], *, slip_deg_s: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["encoder_no_answer"], *, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["shaft_locked"], *, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["coulomb_friction"], *, torque_Nm: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["static_friction"], *, torque_Nm: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["load_dropped"], *, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["supply_lost"], *, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["supply_sagged"], *, depth_percent: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["supply_surged"], *, height_percent: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["supply_ripple"], *, amplitude_V: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["chopper_open"], *, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["interrupt_lost"], *, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["background_hung"], *, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["interrupt_late"], *, time_us: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["interrupt_storm"], *, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["winding_temperature_sensor_open"], *, phase: Literal["a", "b", "c", "d", "e", "f"], duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["winding_temperature_sensor_shorted"], *, phase: Literal["a", "b", "c", "d", "e", "f"], duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["winding_temperature_sensor_stuck"], *, phase: Literal["a", "b", "c", "d", "e", "f"], code: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["winding_temperature_sensor_offset"], *, phase: Literal["a", "b", "c", "d", "e", "f"], offset_K: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["inverter_temperature_sensor_open"], *, phase: Literal["a", "b", "c", "d", "e", "f"], duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["inverter_temperature_sensor_shorted"], *, phase: Literal["a", "b", "c", "d", "e", "f"], duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["inverter_temperature_sensor_stuck"], *, phase: Literal["a", "b", "c", "d", "e", "f"], code: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["inverter_temperature_sensor_offset"], *, phase: Literal["a", "b", "c", "d", "e", "f"], offset_K: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["limit_flipped"], *, bit: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["constant_flipped"], *, bit: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["state_flipped"], *, bit: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["fault_latch_flipped"], *, bit: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["code_flipped"], *, byte: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["stack_guard_flipped"], *, bit: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["period_register_flipped"], *, bit: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["clock_drift"], *, drift_percent: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: str, *, duration_s: float | None = None, **arguments: Any) -> Fault: ...

class Bench(_Bench):
    drive: Drive
    rig: Rig
    telemetry: Telemetry
    truth: Truth
    def at(self, time_s: float) -> Rig: ...
    @overload
    def fault(self, kind: Literal["winding_open"], *, phase: Literal["a", "b", "c", "d", "e", "f"], duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["switch_open"], *, phase: Literal["a", "b", "c", "d", "e", "f"], leg: Literal["high", "low"], duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["switch_shorted"], *, phase: Literal["a", "b", "c", "d", "e", "f"], leg: Literal["high", "low"], duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["diode_open"], *, phase: Literal["a", "b", "c", "d", "e", "f"], leg: Literal["high", "low"], duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["gate_supply_lost"], *, phase: Literal["a", "b", "c", "d", "e", "f"], duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["winding_shorted"], *, phase: Literal["a", "b", "c", "d", "e", "f"], turns_percent: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["winding_to_earth"], *, phase: Literal["a", "b", "c", "d", "e", "f"], resistance_ohm: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["current_sensor_open"], *, phase: Literal["a", "b", "c", "d", "e", "f"], duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["current_sensor_stuck"], *, phase: Literal["a", "b", "c", "d", "e", "f"], code: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["current_sensor_low_rail"], *, phase: Literal["a", "b", "c", "d", "e", "f"], duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["current_sensor_high_rail"], *, phase: Literal["a", "b", "c", "d", "e", "f"], duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["current_sensor_gain"], *, phase: Literal["a", "b", "c", "d", "e", "f"], gain: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["current_sensor_offset"], *, phase: Literal["a", "b", "c", "d", "e", "f"], offset_A: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["current_sensor_swapped"], *, phase: Literal["a", "b", "c", "d", "e", "f"], with_phase: Literal["a", "b", "c", "d", "e", "f"], duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["dc_link_sensor_open"], *, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["dc_link_sensor_stuck"], *, code: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["dc_link_sensor_low_rail"], *, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["dc_link_sensor_high_rail"], *, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["dc_link_sensor_gain"], *, gain: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["dc_link_sensor_offset"], *, offset_V: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["encoder_stuck"], *, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["encoder_jump"], *, angle_deg: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["encoder_lost_counts"], *, counts_per_turn: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["encoder_noise"], *, deviation_deg: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["encoder_reversed"], *, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["encoder_slip"], *, slip_deg_s: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["encoder_no_answer"], *, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["shaft_locked"], *, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["coulomb_friction"], *, torque_Nm: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["static_friction"], *, torque_Nm: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["load_dropped"], *, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["supply_lost"], *, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["supply_sagged"], *, depth_percent: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["supply_surged"], *, height_percent: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["supply_ripple"], *, amplitude_V: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["chopper_open"], *, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["interrupt_lost"], *, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["background_hung"], *, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["interrupt_late"], *, time_us: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["interrupt_storm"], *, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["winding_temperature_sensor_open"], *, phase: Literal["a", "b", "c", "d", "e", "f"], duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["winding_temperature_sensor_shorted"], *, phase: Literal["a", "b", "c", "d", "e", "f"], duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["winding_temperature_sensor_stuck"], *, phase: Literal["a", "b", "c", "d", "e", "f"], code: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["winding_temperature_sensor_offset"], *, phase: Literal["a", "b", "c", "d", "e", "f"], offset_K: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["inverter_temperature_sensor_open"], *, phase: Literal["a", "b", "c", "d", "e", "f"], duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["inverter_temperature_sensor_shorted"], *, phase: Literal["a", "b", "c", "d", "e", "f"], duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["inverter_temperature_sensor_stuck"], *, phase: Literal["a", "b", "c", "d", "e", "f"], code: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["inverter_temperature_sensor_offset"], *, phase: Literal["a", "b", "c", "d", "e", "f"], offset_K: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["limit_flipped"], *, bit: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["constant_flipped"], *, bit: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["state_flipped"], *, bit: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["fault_latch_flipped"], *, bit: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["code_flipped"], *, byte: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["stack_guard_flipped"], *, bit: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["period_register_flipped"], *, bit: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: Literal["clock_drift"], *, drift_percent: float, duration_s: float | None = None) -> Fault: ...
    @overload
    def fault(self, kind: str, *, duration_s: float | None = None, **arguments: Any) -> Fault: ...
