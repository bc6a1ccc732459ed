"""The A2L file (ASAM MCD-2 MC, ASAP2 1.71) of a drive, for measurement and calibration tools: its variables by their
place in memory (measurements), its parameters (characteristics), and how it is reached by XCP on CAN.

Made of the debug information of a build, the parameter table and the units of a machine; never edited. EPK, which tools
compare before they measure, is what the drive responds as identification (firmware/comms/xcp.h).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from salient.bench.variables import SIGNALS, Quantity, Variables
from salient.bench.xcp import AREA_PARAMETERS, AREA_TEXT, COMMAND_ID, RESPONSE_ID
from salient.dbc import NODE_STEP, database_hash
from salient.errors import UsageError
from salient.machine.file import load_machine
from salient.machine.parameter_table import CHOICES, ParameterDefinition, read_table
from salient.machine.path import machine_path
from salient.machine.scaling import Scaling, database_of, scaling_of

ELEMENTS_MAX = 16
"""Limit of an array; the members of longer ones, as the rings of traces, are no signals."""
BIT_RATE = 1_000_000
EVENTS = ("control", "background", "deferred", "identify")
_WORD_BYTES = 4
_TYPES = {(1, False): "UBYTE", (1, True): "SBYTE", (2, False): "UWORD", (2, True): "SWORD", (4, False): "ULONG",
          (4, True): "SLONG"}


def a2l_of(machine: str, build: str = "host", node: int = 0) -> str:
    """The file's text. machine: name or file; build: of the program, which has the addresses. UsageError: no such
    machine, or the build has no layout (salient.drive_layout)."""
    path = machine_path(machine)
    scaling = scaling_of(path, load_machine(path))
    variables = Variables(build, machine)
    quantities = [*(variables.quantity(name) for name in SIGNALS if name not in variables.paths),
                  *(each for each in variables.quantities() if is_short(each.variable.path))]
    methods = _Methods()
    rows = list(zip(read_table(), scaling.fraction_bits(), strict=True))
    body = "\n".join([*(_measurement(each, methods) for each in quantities),
                      *(_characteristic(row, bits, methods) for row, bits in rows)])
    head = _HEAD.format(machine=path.stem, epk=epk_of(variables, scaling), address=f"{AREA_TEXT:#010x}",
                        xcp=_xcp(node))
    return f"{head}\n{body}\n{methods.text()}\n  /end MODULE\n/end PROJECT\n"


def epk_of(variables: Variables, scaling: Scaling) -> str:
    """The identification of a drive of this layout and machine."""
    layout = variables.layout
    return f"salient{layout.hash:08x}{database_hash(database_of(scaling.dbc())):08x}{layout.size // _WORD_BYTES:08x}"


def write_a2l(file: Path, machine: str, node: int = 0) -> None:
    """Writes the file of a drive on the host. UsageError: it cannot be written, or as a2l_of."""
    try:
        file.write_text(a2l_of(machine, node=node), encoding="ascii")
    except OSError as error:
        raise UsageError(f"--a2l {file}: {error.strerror}") from None


def is_short(path: str) -> bool:
    """False for members of arrays that are no signals."""
    return all(int(index) < ELEMENTS_MAX for index in re.findall(r"\[(\d+)\]", path))


class _Methods:
    """Conversions, each once."""

    def __init__(self) -> None:
        self._texts: dict[str, str] = {}

    def linear(self, unit: str, factor: float) -> str:
        """Name of value = factor * raw."""
        if not unit and factor == 1.0:
            return "NO_COMPU_METHOD"
        name = f"LINEAR_{_identifier(unit)}_{_identifier(f'{factor:.12g}')}"
        self._texts[name] = (f'  /begin COMPU_METHOD {name} "value = {factor:.12g} * raw" RAT_FUNC "%12.6" "{unit}"\n'
                             f"    COEFFS 0 1 0 0 0 {factor:.17g}\n  /end COMPU_METHOD")
        return name

    def names(self, of: Iterable[tuple[int, str]]) -> str:
        """Name of a table of texts."""
        pairs = list(of)
        name = f"NAMES_{_identifier('_'.join(text for _, text in pairs))[:80]}_{len(pairs)}"
        rows = "\n".join(f'    {value} "{text}"' for value, text in pairs)
        self._texts[name] = (f'  /begin COMPU_METHOD {name} "names" TAB_VERB "%4.0" ""\n'
                             f"    COMPU_TAB_REF {name}_TABLE\n  /end COMPU_METHOD\n"
                             f'  /begin COMPU_VTAB {name}_TABLE "names" TAB_VERB {len(pairs)}\n{rows}\n'
                             "  /end COMPU_VTAB")
        return name

    def text(self) -> str:
        return "\n".join(self._texts[name] for name in sorted(self._texts))


def _identifier(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9]", lambda found: {"-": "m", "/": "per", "^": ""}.get(found[0], "_"), text)


def _measurement(quantity: Quantity, methods: _Methods) -> str:
    variable = quantity.variable
    bits = 8 * variable.bytes
    low, high = (-(1 << bits - 1), (1 << bits - 1) - 1) if variable.is_signed else (0, (1 << bits) - 1)
    if variable.names:
        method, low, high = methods.names(variable.names.items()), min(variable.names), max(variable.names)
    else:
        method = methods.linear(quantity.unit, quantity.factor)
    return (f'  /begin MEASUREMENT {quantity.name} "{_description(variable.path)}"\n'
            f"    {_TYPES[variable.bytes, variable.is_signed]} {method} 0 0 "
            f"{low * quantity.factor:.12g} {high * quantity.factor:.12g}\n"
            f"    ECU_ADDRESS {variable.address:#010x}\n  /end MEASUREMENT")


def _description(path: str) -> str:
    return re.sub(r"_q\d+", "", path.rsplit(".", 1)[-1]).replace("_", " ")


def _characteristic(row: ParameterDefinition, fraction_bits: int, methods: _Methods) -> str:
    factor = math.ldexp(1.0, -fraction_bits)
    names = CHOICES.get(row.name)
    method = methods.names(enumerate(names)) if names else methods.linear(row.unit, factor)
    text = re.sub(r"\s+", " ", row.text).replace('"', "'")
    tunable = "" if row.tunable else " Not while the drive runs."
    return (f'  /begin CHARACTERISTIC {row.name} "{text}{tunable}"\n'
            f"    VALUE {AREA_PARAMETERS + _WORD_BYTES * row.index:#010x} PARAMETER 0 {method} "
            f"{row.minimum * factor:.12g} {row.maximum * factor:.12g}\n"
            "  /end CHARACTERISTIC")


def _xcp(node: int) -> str:
    events: Iterator[str] = (
        f'        /begin EVENT "{name}" "{name}" {number} DAQ 1 0 0 0 /end EVENT' for number, name in enumerate(EVENTS))
    return _XCP.format(events="\n".join(events), count=len(EVENTS), command=f"{COMMAND_ID + NODE_STEP * node:#x}",
                       response=f"{RESPONSE_ID + NODE_STEP * node:#x}", bit_rate=BIT_RATE)


_HEAD = """ASAP2_VERSION 1 71
/begin PROJECT salient "Drive for a switched reluctance motor"
  /begin MODULE {machine} "Machine {machine}"
  /begin MOD_PAR "Drive"
    EPK "{epk}"
    ADDR_EPK {address}
  /end MOD_PAR
  /begin MOD_COMMON "Low byte first"
    BYTE_ORDER MSB_LAST
    ALIGNMENT_BYTE 1
    ALIGNMENT_WORD 2
    ALIGNMENT_LONG 4
  /end MOD_COMMON
  /begin RECORD_LAYOUT PARAMETER
    FNC_VALUES 1 SLONG ROW_DIR DIRECT
  /end RECORD_LAYOUT
{xcp}"""

_XCP = """  /begin IF_DATA XCP
    /begin PROTOCOL_LAYER
      0x0100 2000 10000 0 0 0 0 0 8 8 BYTE_ORDER_MSB_LAST ADDRESS_GRANULARITY_BYTE
      OPTIONAL_CMD GET_ID
      OPTIONAL_CMD SET_REQUEST
      OPTIONAL_CMD GET_SEED
      OPTIONAL_CMD UNLOCK
      OPTIONAL_CMD SET_MTA
      OPTIONAL_CMD UPLOAD
      OPTIONAL_CMD SHORT_UPLOAD
      OPTIONAL_CMD DOWNLOAD
      OPTIONAL_CMD SET_DAQ_PTR
      OPTIONAL_CMD WRITE_DAQ
      OPTIONAL_CMD SET_DAQ_LIST_MODE
      OPTIONAL_CMD GET_DAQ_LIST_MODE
      OPTIONAL_CMD START_STOP_DAQ_LIST
      OPTIONAL_CMD START_STOP_SYNCH
      OPTIONAL_CMD GET_DAQ_CLOCK
      OPTIONAL_CMD GET_DAQ_PROCESSOR_INFO
      OPTIONAL_CMD GET_DAQ_RESOLUTION_INFO
      OPTIONAL_CMD GET_DAQ_LIST_INFO
      OPTIONAL_CMD GET_DAQ_EVENT_INFO
      OPTIONAL_CMD FREE_DAQ
      OPTIONAL_CMD ALLOC_DAQ
      OPTIONAL_CMD ALLOC_ODT
      OPTIONAL_CMD ALLOC_ODT_ENTRY
      COMMUNICATION_MODE_SUPPORTED BLOCK SLAVE
    /end PROTOCOL_LAYER
    /begin DAQ
      DYNAMIC 1 {count} 0 OPTIMISATION_TYPE_DEFAULT ADDRESS_EXTENSION_FREE IDENTIFICATION_FIELD_TYPE_ABSOLUTE
      GRANULARITY_ODT_ENTRY_SIZE_DAQ_BYTE 4 OVERLOAD_INDICATION_EVENT PRESCALER_SUPPORTED
      /begin TIMESTAMP_SUPPORTED
        1 SIZE_WORD UNIT_1US
      /end TIMESTAMP_SUPPORTED
{events}
    /end DAQ
    /begin XCP_ON_CAN
      0x0100
      CAN_ID_MASTER {command}
      CAN_ID_SLAVE {response}
      BAUDRATE {bit_rate}
    /end XCP_ON_CAN
  /end IF_DATA"""
