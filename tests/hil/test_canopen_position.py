"""Modes of position of CiA 402: the package `canopen` moves the motor, homes it and leads it along a sine."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest
from test_canopen import enable, master, refused, state

canopen = pytest.importorskip("canopen")

pytestmark = pytest.mark.bench_options(protocol="canopen")

UNITS = 131072
"""Position units in a revolution, with the feed constant after a reset; also counts of 17 bits."""
NEW, AT_ONCE, RELATIVE, HALT, ENABLED = 0x10, 0x20, 0x40, 0x100, 0x0F
REACHED, ACKNOWLEDGED, LIMITED, ERROR = 0x400, 0x1000, 0x800, 0x2000


def angle_rev(bench):
    """True angle over turns since the start of the record, and its times."""
    angle = bench.truth["rotor_angle_deg"]
    return np.unwrap(np.asarray(angle.value, dtype=float), period=360.0) / 360, np.asarray(angle.time_s)


def word(node):
    return node.sdo[0x6041].raw


def control(node, bits=0):
    node.sdo[0x6040].raw = ENABLED | bits


def wait(network, node, mask, value, timeout_s=2.0):
    for _ in range(round(timeout_s / 0.005)):
        if word(node) & mask == value:
            return
        network.run_for(0.003)
    pytest.fail(f"statusword {word(node):#06x}: {mask:#06x} is not {value:#06x}, {state(node)}")


def set_point(network, node, target, bits=0):
    """A set-point with its handshake."""
    node.sdo[0x607A].raw = target
    control(node, NEW | bits)
    wait(network, node, ACKNOWLEDGED, ACKNOWLEDGED, 0.05)
    control(node)


def fast(node):
    """Limits beyond the drive's own, which count then."""
    node.sdo[0x6081].raw = 100_000
    node.sdo[0x6083].raw = node.sdo[0x6084].raw = 1_000_000


def holding(network, node, mode=1):
    enable(node, mode)
    network.run_for(0.02)
    assert node.sdo[0x6061].raw == mode
    return node.sdo[0x6064].raw


@pytest.mark.parametrize("machine", ["saturating", "finite_element", "linear_cosine"])
def test_absolute_and_relative_moves_end_at_their_targets(make_bench, tmp_path, machine):
    bench = make_bench(protocol="canopen", machine=machine)
    with master(bench, tmp_path) as (network, node):
        begin = holding(network, node)
        begin_rev = angle_rev(bench)[0][-1]
        node.sdo[0x6068].raw = 20
        fast(node)
        for target, bits, expected in ((UNITS // 4, 0, UNITS // 4), (-3 * UNITS, 0, -3 * UNITS),
                                       (UNITS // 2, RELATIVE, -5 * UNITS // 2), (36, RELATIVE, 36 - 5 * UNITS // 2)):
            set_point(network, node, target, bits)
            wait(network, node, REACHED | ACKNOWLEDGED, REACHED)
            network.run_for(0.05)
            assert node.sdo[0x6064].raw == pytest.approx(expected, abs=3)
            assert node.sdo[0x6062].raw == expected
            moved = (angle_rev(bench)[0][-1] - begin_rev) * UNITS
            assert moved == pytest.approx(expected - begin, abs=4)
        assert state(node) == "enabled"


def test_profile_velocity_acceleration_and_jerk_bound_the_move(bench, tmp_path):
    with master(bench, tmp_path) as (network, node):
        holding(network, node)
        node.sdo[0x6081].raw, node.sdo[0x6083].raw, node.sdo[0x6084].raw = 120, 1000, 2000
        begin_s = bench.time_s
        set_point(network, node, UNITS)
        wait(network, node, REACHED, REACHED)
        duration_s = bench.time_s - begin_s
        speed = bench.truth["speed_rpm"].between(begin_s, bench.time_s)
        assert np.max(speed.value) == pytest.approx(120, abs=1.5)
        assert duration_s == pytest.approx(0.5 + 0.12 / 2 + 0.06 / 2, abs=0.03)
        node.sdo[0x6086].raw, node.sdo[0x60A4][1].raw = 3, 5000
        begin_s = bench.time_s
        set_point(network, node, 0)
        wait(network, node, REACHED, REACHED, 3.0)
        assert bench.time_s - begin_s > duration_s + 0.15  # the acceleration rises for 0.15 s and more


def test_a_set_of_set_points_stops_at_each_and_a_change_on_the_fly_at_none(bench, tmp_path):
    with master(bench, tmp_path) as (network, node):
        holding(network, node)
        fast(node)
        set_point(network, node, UNITS)
        set_point(network, node, 2 * UNITS)
        assert word(node) & (ACKNOWLEDGED | REACHED) == ACKNOWLEDGED  # one waits
        wait(network, node, ACKNOWLEDGED, 0)
        assert node.sdo[0x6064].raw == pytest.approx(UNITS, abs=UNITS / 10)
        wait(network, node, REACHED, REACHED)
        assert node.sdo[0x6064].raw == pytest.approx(2 * UNITS, abs=20)
        begin_s = bench.time_s
        set_point(network, node, 6 * UNITS)
        network.run_for(0.06)
        assert bench.truth["speed_rpm"].last > 200
        set_point(network, node, UNITS, AT_ONCE)
        wait(network, node, REACHED, REACHED)
        network.run_for(0.03)
        assert node.sdo[0x6064].raw == pytest.approx(UNITS, abs=3)
        speed = bench.truth["speed_rpm"].between(begin_s, bench.time_s)
        turns = np.diff(np.sign(np.where(np.abs(speed.value) < 5, 0, speed.value))[np.abs(speed.value) >= 5])
        assert np.count_nonzero(turns) == 1  # back once, without a stop at the first target


def test_halt_stops_the_move_which_goes_on_after_it(bench, tmp_path):
    with master(bench, tmp_path) as (network, node):
        holding(network, node)
        fast(node)
        set_point(network, node, 10 * UNITS)
        network.run_for(0.1)
        control(node, HALT)
        wait(network, node, REACHED, REACHED)
        network.run_for(0.05)
        assert abs(bench.truth["speed_rpm"].last) < 1
        assert abs(node.sdo[0x6064].raw) < 9 * UNITS
        control(node)
        wait(network, node, REACHED, REACHED)
        network.run_for(0.03)
        assert node.sdo[0x6064].raw == pytest.approx(10 * UNITS, abs=3)


def test_software_limits_bound_the_target_and_polarity_and_feed_scale_it(bench, tmp_path):
    with master(bench, tmp_path) as (network, node):
        node.sdo[0x6092][1].raw, node.sdo[0x607E].raw = 36000, 0x80  # 0.01 degrees, backwards
        begin = holding(network, node)
        begin_rev = angle_rev(bench)[0][-1]
        node.sdo[0x607D][2].raw = begin + 9000
        fast(node)
        begin_s = bench.time_s
        set_point(network, node, begin + 30000)
        wait(network, node, REACHED, REACHED)
        network.run_for(0.05)
        assert word(node) & LIMITED
        assert node.sdo[0x6064].raw == pytest.approx(begin + 9000, abs=1)
        angle, time_s = angle_rev(bench)
        assert angle[time_s > begin_s].min() - begin_rev > -0.2502
        assert angle[-1] - begin_rev == pytest.approx(-0.25, abs=2e-4)


@pytest.mark.parametrize(("method", "turns"), [(37, None), (35, None), (34, 1), (33, 0)])
def test_homing_calls_its_place_the_negative_offset(bench, tmp_path, method, turns):
    with master(bench, tmp_path) as (network, node):
        holding(network, node)
        start_rev = angle_rev(bench)[0][-1]
        fast(node)
        set_point(network, node, UNITS // 4)
        wait(network, node, REACHED, REACHED)
        node.sdo[0x6060].raw, node.sdo[0x6098].raw, node.sdo[0x607C].raw = 6, method, -UNITS // 8
        network.run_for(0.01)
        assert word(node) & (ACKNOWLEDGED | ERROR) == 0
        control(node, NEW)
        wait(network, node, ACKNOWLEDGED | REACHED, ACKNOWLEDGED | REACHED, 4.0)
        network.run_for(0.05)
        here = angle_rev(bench)[0][-1]
        begin = node.sdo[0x6064].raw
        assert begin == pytest.approx(UNITS // 8, abs=3)
        if turns is not None:  # the encoder's zero, of which the drive started at an angle of its own
            assert (here - start_rev) * UNITS == pytest.approx(turns * UNITS - first_position(bench), abs=4)
        control(node)
        control(node, NEW)  # once more
        if turns is not None:  # the present place is found before the statusword can be read
            wait(network, node, ACKNOWLEDGED, 0, 0.05)
        wait(network, node, ACKNOWLEDGED | REACHED, ACKNOWLEDGED | REACHED, 4.0)


def first_position(bench):
    """Encoder at the start of the record, in counts of 17 bits."""
    return bench.truth["rotor_angle_deg"].value[0] / 360 * UNITS


def test_homing_to_a_stop_and_its_failure(bench, tmp_path):
    with master(bench, tmp_path) as (network, node):
        holding(network, node, mode=6)
        node.sdo[0x6098].raw = -2
        bench.held_speed_rpm = 0
        control(node, NEW)
        wait(network, node, ACKNOWLEDGED, ACKNOWLEDGED)
        control(node)
        node.sdo[0x6098].raw = 34  # the zero of the encoder does not come at a held shaft
        control(node, NEW)
        wait(network, node, ERROR, ERROR, 4.0)
        assert word(node) & ACKNOWLEDGED == 0
        for wrong in (0, 1, 17, 36):
            assert refused(node.sdo[0x6098], wrong) == 0x06090030


@pytest.mark.parametrize("cycle_ms", [2, 10])
def test_a_cyclic_sine_is_followed_and_a_stopped_master_is_the_specified_reaction(bench, tmp_path, cycle_ms):
    with master(bench, tmp_path) as (network, node):
        emergencies = []
        node.emcy.add_callback(emergencies.append)
        node.rpdo.read()
        rpdo = node.rpdo[1]
        rpdo.clear()
        for index in (0x6040, 0x607A):
            rpdo.add_variable(index)
        rpdo.trans_type, rpdo.event_timer, rpdo.enabled = 255, 0, True
        rpdo.save()
        node.sdo[0x1400][5].raw = 100
        node.sdo[0x60C2][1].raw = cycle_ms
        begin = holding(network, node, mode=8)
        begin_s, amplitude, frequency_Hz = bench.time_s, 1300, 5.0
        while bench.time_s < begin_s + 0.7:
            time_s = bench.time_s - begin_s
            rpdo[0].raw = ENABLED
            rpdo[1].raw = begin + round(
                amplitude * min(1, 5 * time_s) * math.sin(2 * math.pi * frequency_Hz * time_s))
            sent_s = bench.time_s
            rpdo.transmit()
            while bench.time_s < sent_s + cycle_ms * 1e-3 - 1e-6:
                bench.run_for(min(1e-3, sent_s + cycle_ms * 1e-3 - bench.time_s))
        assert word(node) & (ACKNOWLEDGED | ERROR) == ACKNOWLEDGED
        angle, time_s = angle_rev(bench)
        since_s = time_s - begin_s
        late = (since_s > 0.3) & (since_s < 0.69)
        place = (angle - angle[np.searchsorted(time_s, begin_s) - 1]) * UNITS
        waves = np.stack([np.sin(2 * math.pi * frequency_Hz * since_s), np.cos(2 * math.pi * frequency_Hz * since_s)])
        parts, residual, *_ = np.linalg.lstsq(waves[:, late].T, place[late], rcond=None)
        delay_s = -math.atan2(parts[1], parts[0]) / (2 * math.pi * frequency_Hz)
        assert math.hypot(*parts) == pytest.approx(amplitude, rel=0.03)
        assert cycle_ms * 1e-3 <= delay_s <= (cycle_ms + 4) * 1e-3
        assert math.sqrt(residual[0] / late.sum()) < 20  # counts
        # The master has stopped: after three cycles bit 12 falls and the reference stops, after 100 ms a quick stop.
        network.run_for(max(0.015, 4e-3 * cycle_ms))
        assert word(node) & ACKNOWLEDGED == 0
        network.run_for(0.03)
        assert abs(bench.truth["speed_rpm"].last) < 3
        assert state(node) == "enabled" and not emergencies
        network.run_for(0.3)
        assert [emergency.code for emergency in emergencies] == [0x8250]
        assert state(node) == "switch on disabled"


def test_a_following_error_is_a_stop_with_its_emergency_until_a_halt(bench, tmp_path):
    with master(bench, tmp_path) as (network, node):
        emergencies = []
        node.emcy.add_callback(emergencies.append)
        holding(network, node)
        node.sdo[0x6065].raw = UNITS // 180
        bench.load_torque_Nm = 30
        wait(network, node, ERROR, ERROR, 0.5)
        bench.load_torque_Nm = 0
        assert [emergency.code for emergency in emergencies] == [0x8611]
        assert node.sdo[0x603F].raw == 0x8611
        fast(node)
        before = node.sdo[0x6064].raw
        set_point(network, node, before + UNITS)
        network.run_for(0.2)
        assert abs(bench.truth["speed_rpm"].last) < 1
        control(node, HALT)
        wait(network, node, ERROR, 0, 0.05)
        control(node)
        wait(network, node, REACHED, REACHED)
        assert emergencies[-1].code == 0 and state(node) == "enabled"


def test_modes_change_in_a_move_and_nothing_jumps(bench, tmp_path):
    with master(bench, tmp_path) as (network, node):
        drawn = random.Random(402)
        holding(network, node)
        fast(node)
        begin_s = bench.time_s
        for _ in range(40):
            mode = drawn.choice((1, 3, 6, 8, 9))
            node.sdo[0x6060].raw = mode
            network.run_for(drawn.uniform(0, 0.004))
            target = drawn.randint(-4 * UNITS, 4 * UNITS)
            node.sdo[0x607A].raw, node.sdo[0x60FF].raw = target, drawn.randint(-300, 300)
            control(node, drawn.choice((NEW, NEW | AT_ONCE, NEW | RELATIVE, 0, HALT)))
            network.run_for(drawn.uniform(0, 0.03))
            control(node)
            assert state(node) == "enabled"
        speed = bench.truth["speed_rpm"].between(begin_s, bench.time_s)
        assert np.max(np.abs(np.diff(speed.value)) / np.diff(speed.time_s)) < 4e5  # r/min/s: rated torque, no jump
        assert np.max(np.abs(speed.value)) < 3200
        node.sdo[0x6060].raw = 1
        network.run_for(0.3)
        assert abs(bench.truth["speed_rpm"].last) < 1
        set_point(network, node, 0)
        wait(network, node, REACHED, REACHED, 3.0)


def test_random_mapping_of_the_new_objects_has_the_values_of_sdo(bench, tmp_path):
    drawn = random.Random(607)
    objects = [0x6062, 0x6064, 0x6068, 0x607A, 0x607C, 0x6081, 0x609A, 0x60F4]
    with master(bench, tmp_path) as (network, node):
        node.tpdo.read()
        node.rpdo.read()
        for _ in range(12):
            number, chosen = drawn.randint(1, 4), drawn.sample(objects, 2)
            written = drawn.sample([0x6068, 0x607A, 0x607C, 0x6081, 0x609A], 2)
            node.nmt.state = "PRE-OPERATIONAL"
            for pdo, indices in ((node.tpdo[number], chosen), (node.rpdo[number], written)):
                pdo.clear()
                for index in indices:
                    pdo.add_variable(index)
                pdo.trans_type, pdo.enabled = 1 if pdo is node.tpdo[number] else 255, True
                pdo.save()
            node.nmt.state = "OPERATIONAL"
            rpdo = node.rpdo[number]
            values = [drawn.randint(1, 65535) for _ in written]
            for variable, value in zip(rpdo, values, strict=True):
                variable.raw = value
            rpdo.transmit()
            network.run_for(0.002)
            assert [node.sdo[index].raw for index in written] == values
            network.send_message(0x80, b"")
            for variable, index in zip(node.tpdo[number], chosen, strict=True):
                assert variable.raw == pytest.approx(node.sdo[index].raw, abs=2), hex(index)
