"""plant_faults_t of emulator/plant/plant.h for ctypes, and the plant's functions for faults."""

from __future__ import annotations

import ctypes

from reference_plant import PHASES_MAX, State


class Switches(ctypes.Structure):
    _fields_ = [("upper", ctypes.c_uint8), ("lower", ctypes.c_uint8)]


class Faults(ctypes.Structure):
    _fields_ = [
        ("winding_open", ctypes.c_uint8),
        ("switch_open", Switches),
        ("switch_shorted", Switches),
        ("diode_open", Switches),
        ("chopper_open", ctypes.c_bool),
        ("shorted_turns", ctypes.c_double * PHASES_MAX),
        ("coulomb_Nm", ctypes.c_double),
        ("static_Nm", ctypes.c_double),
        ("earth_ohm", ctypes.c_double * PHASES_MAX),
    ]


def set_faults(library: ctypes.CDLL, plant: int, faults: Faults) -> None:
    library.plant_set_faults.argtypes = [ctypes.c_void_p, ctypes.POINTER(Faults)]
    library.plant_set_faults.restype = None
    library.plant_set_faults(plant, ctypes.byref(faults))


def earth(**phases: float) -> Faults:
    """Resistances to earth, by phase letter."""
    faults = Faults()
    for phase, resistance_ohm in phases.items():
        faults.earth_ohm["abcd".index(phase)] = resistance_ohm
    return faults


def lock(library: ctypes.CDLL, plant: int) -> None:
    library.plant_lock.argtypes = [ctypes.c_void_p]
    library.plant_lock.restype = None
    library.plant_lock(plant)


def read(library: ctypes.CDLL, plant: int) -> State:
    state = State()
    library.plant_library_read(plant, ctypes.byref(state))
    return state


def turns(**phases: float) -> Faults:
    """Shorted turns, by phase letter."""
    faults = Faults()
    for phase, fraction in phases.items():
        faults.shorted_turns["abcd".index(phase)] = fraction
    return faults
