"""Return codes of GeoCOM and their meaning for a tracking client. Sans-I/O.

Source: Leica, TPS1200 GeoCOM Reference Manual, version 1.20, appendix A and chapter TMC; codes of newer instruments from
GeoComPy 1.0. Older manuals have other names for the same numbers. In the EDM family 769 to 774 changed their meaning
between generations: nothing depends on them.
"""

from __future__ import annotations

from enum import Enum, IntEnum, auto
from typing import Final, Self


class Outcome(Enum):
    """Meaning of a return code for the caller."""

    USABLE = auto()  # executed, or measured; also with a warning about the battery
    LOW_ACCURACY = auto()
    """Distance and angles are valid, but a correction is missing or uncertain: common while the telescope turns."""
    ANGLE_ONLY = auto()  # the angles are valid, there is no distance
    NO_TARGET = auto()  # no prism is detected, or no distance can be measured to it
    TILT = auto()  # nothing is valid, usually because the instrument is not level
    WRONG_DISTANCE = auto()
    """The distance is unusable because of the instrument's settings for its correction."""
    BUSY = auto()  # a procedure is in progress, or a distance is still stored: retry later, or after clearing
    ASLEEP = auto()  # the instrument sleeps or is off; a request wakes it up
    LICENCE = auto()  # not permitted: the licence GeoCOM Robotic is missing
    UNAVAILABLE = auto()  # not supported: no such procedure, or no such component
    SHUT_DOWN = auto()  # the instrument is switching off
    NO_VALUES = auto()  # the code announces values, and none came
    ERROR = auto()  # not executed


class ReturnCode(IntEnum):
    """The codes that a tracking client can receive, by the names of the manual, with their outcome (default: ERROR)."""

    outcome: Outcome

    def __new__(cls, code: int, outcome: Outcome = Outcome.ERROR) -> Self:
        """Create a member from its row of the table."""
        member = int.__new__(cls, code)
        member._value_ = code
        member.outcome = outcome
        return member

    OK = 0, Outcome.USABLE
    UNDEFINED = 1
    IVPARAM = 2
    IVRESULT = 3
    FATAL = 4
    NOT_IMPL = 5, Outcome.UNAVAILABLE
    TIME_OUT = 6
    SET_INCOMPL = 7
    ABORT = 8
    NOMEMORY = 9
    NOTINIT = 10
    SHUT_DOWN = 12, Outcome.SHUT_DOWN
    SYSBUSY = 13, Outcome.BUSY
    HWFAILURE = 14
    ABORT_APPL = 15
    LOW_POWER = 16, Outcome.USABLE
    IVVERSION = 17
    BATT_EMPTY = 18, Outcome.USABLE
    NO_EVENT = 20
    OUT_OF_TEMP = 21
    INSTRUMENT_TILT = 22, Outcome.TILT
    COM_SETTING = 23
    NO_ACTION = 24
    SLEEP_MODE = 25, Outcome.ASLEEP
    NOTOK = 26
    NA = 27, Outcome.LICENCE
    OVERFLOW = 28
    STOPPED = 29

    ANG_ERROR = 257
    ANG_INCL_ERROR = 258, Outcome.TILT
    ANG_BAD_ACC = 259
    ANG_BAD_ANGLE_ACC = 260
    ANG_BAD_INCLIN_ACC = 261
    ANG_OUT_OF_RANGE = 267
    ANG_HZ_MOVED = 269

    ATA_NOT_READY = 512, Outcome.BUSY
    ATA_NO_RESULT = 513, Outcome.NO_TARGET
    ATA_SEVERAL_TARGETS = 514, Outcome.NO_TARGET
    ATA_BIG_SPOT = 515, Outcome.NO_TARGET
    ATA_BACKGROUND = 516, Outcome.NO_TARGET
    ATA_NO_TARGETS = 517, Outcome.NO_TARGET
    ATA_NOT_ACCURAT = 518, Outcome.NO_TARGET
    ATA_SPOT_ON_EDGE = 519, Outcome.NO_TARGET
    ATA_BLOOMING = 522, Outcome.NO_TARGET
    ATA_NOT_BUSY = 523
    ATA_STRANGE_LIGHT = 524, Outcome.NO_TARGET
    ATA_PS_NOT_READY = 538, Outcome.BUSY
    ATA_ATR_SYSTEM_ERR = 539

    EDM_COMERR = 769
    EDM_TIMEOUT = 775, Outcome.NO_TARGET
    EDM_FLUKT_ERR = 776, Outcome.NO_TARGET
    EDM_FMOT_ERR = 777
    EDM_DEV_NOT_INSTALLED = 778, Outcome.UNAVAILABLE
    EDM_NOT_FOUND = 779
    EDM_ERROR_RECEIVED = 780
    EDM_INTERNAL_ERR = 785
    EDM_BUSY = 786, Outcome.BUSY
    EDM_NO_MEASACTIVITY = 787, Outcome.NO_TARGET
    EDM_INIT_OR_STOP_ERR = 789
    EDM_MEAS_ABORTED = 791
    EDM_DISTRANGE_ERR = 818, Outcome.NO_TARGET
    EDM_SIGNTONOISE_ERR = 819, Outcome.NO_TARGET
    EDM_NOISEHIGH_ERR = 820, Outcome.NO_TARGET
    EDM_MULTRG_ERR = 823, Outcome.NO_TARGET
    EDM_MEAS_DIST_NOT_ALLOWED = 826
    EDM_DIST_TOO_SHORT = 829, Outcome.NO_TARGET

    TMC_NO_FULL_CORRECTION = 1283, Outcome.LOW_ACCURACY
    TMC_ACCURACY_GUARANTEE = 1284, Outcome.LOW_ACCURACY
    TMC_ANGLE_OK = 1285, Outcome.ANGLE_ONLY
    TMC_ANGLE_NOT_FULL_CORR = 1288, Outcome.ANGLE_ONLY
    TMC_ANGLE_NO_ACC_GUARANTY = 1289, Outcome.ANGLE_ONLY
    TMC_ANGLE_ERROR = 1290, Outcome.TILT
    TMC_DIST_PPM = 1291, Outcome.WRONG_DISTANCE
    TMC_DIST_ERROR = 1292, Outcome.NO_TARGET
    TMC_BUSY = 1293, Outcome.BUSY
    TMC_SIGNAL_ERROR = 1294
    TMC_OLD_PLANE = 1380
    TMC_NO_PLANE = 1381
    TMC_INCLINE_ACC = 1383

    MOT_UNREADY = 1792
    MOT_BUSY = 1793, Outcome.BUSY
    MOT_NOT_OCONST = 1794
    MOT_NOT_CONFIG = 1795
    MOT_NOT_POSIT = 1796
    MOT_NOT_BUSY = 1798
    MOT_NOT_LOCK = 1799, Outcome.NO_TARGET
    MOT_HZ_MOTOR_ERROR = 1804
    MOT_V_MOTOR_ERROR = 1805
    MOT_TIMEOUT = 1806

    BMM_XFER_PENDING = 2305
    BMM_NOT_INSTALLED = 2308, Outcome.UNAVAILABLE

    COM_ERO = 3072
    COM_CANT_ENCODE = 3073
    COM_CANT_DECODE = 3074
    COM_CANT_SEND = 3075
    COM_CANT_RECV = 3076
    COM_TIMEDOUT = 3077
    COM_WRONG_FORMAT = 3078
    COM_VER_MISMATCH = 3079
    COM_CANT_DECODE_REQ = 3080
    COM_PROC_UNAVAIL = 3081, Outcome.UNAVAILABLE
    COM_CANT_ENCODE_REP = 3082
    COM_SYSTEM_ERR = 3083
    COM_FAILED = 3085
    COM_NO_BINARY = 3086
    COM_INTR = 3087
    COM_REQUIRES_8DBITS = 3090
    COM_TR_ID_MISMATCH = 3093
    COM_NOT_GEOCOM = 3094
    COM_UNKNOWN_PORT = 3095
    COM_OVERRUN = 3100
    COM_SRVR_RX_CHECKSUM_ERROR = 3101
    COM_CLNT_RX_CHECKSUM_ERROR = 3102
    COM_PORT_NOT_AVAILABLE = 3103
    COM_PORT_NOT_OPEN = 3104
    COM_NO_PARTNER = 3105
    COM_CONS_REQ = 3107, Outcome.BUSY
    COM_SRVR_IS_SLEEPING = 3108, Outcome.ASLEEP
    COM_SRVR_IS_OFF = 3109, Outcome.ASLEEP
    COM_NO_CHECKSUM = 3110, Outcome.UNAVAILABLE

    AUT_TIMEOUT = 8704
    AUT_DETENT_ERROR = 8705
    AUT_ANGLE_ERROR = 8706
    AUT_MOTOR_ERROR = 8707
    AUT_INCACC = 8708
    AUT_DEV_ERROR = 8709
    AUT_NO_TARGET = 8710, Outcome.NO_TARGET
    AUT_MULTIPLE_TARGETS = 8711, Outcome.NO_TARGET
    AUT_BAD_ENVIRONMENT = 8712, Outcome.NO_TARGET
    AUT_DETECTOR_ERROR = 8713
    AUT_NOT_ENABLED = 8714
    AUT_CALACC = 8715
    AUT_ACCURACY = 8716
    AUT_DIST_STARTED = 8717
    AUT_SUPPLY_TOO_HIGH = 8718
    AUT_SUPPLY_TOO_LOW = 8719
    AUT_NO_WORKING_AREA = 8720
    AUT_ARRAY_FULL = 8721
    AUT_NO_DATA = 8722
    AUT_SIDECOVER_ERR = 8723
    AUT_OUT_OF_SYNC = 8724
    AUT_NO_LOCK = 8725, Outcome.NO_TARGET

    BAP_CHANGE_ALL_TO_DIST = 9217
    KDM_NOT_AVAILABLE = 12_544, Outcome.UNAVAILABLE
    FTR_FILEACCESS = 13_056


_BY_NUMBER: Final = {int(code): code for code in ReturnCode}

_WITH_VALUES: Final = frozenset({Outcome.LOW_ACCURACY, Outcome.ANGLE_ONLY})

_TMC_WARNINGS: Final = frozenset(range(1280, 1400)) - {ReturnCode.TMC_SIGNAL_ERROR}
"""Newer firmware has warnings in this range that no available manual lists."""

_FAMILIES: Final = {
    0: "TPS", 1: "ANG", 2: "ATA", 3: "EDM", 4: "GMF", 5: "TMC", 6: "MEM", 7: "MOT", 8: "LDR", 9: "BMM",
    10: "TXT", 11: "MMI", 12: "COM", 13: "DPL", 15: "FIL", 19: "DPL", 20: "WIR", 34: "AUT", 36: "BAP",
    37: "SAP", 38: "COD", 39: "BAS", 40: "IOS", 41: "CNF", 47: "DNA", 49: "KDM", 51: "FTR", 54: "CAM",
}  # fmt: skip
"""Components of the instrument's software, by the high byte of their codes."""


def outcome_of(code: int, *, has_values: bool) -> Outcome:
    """Return the meaning of a return code; one that announces valid values without any is NO_VALUES."""
    known = _BY_NUMBER.get(code)
    outcome = Outcome.ERROR if known is None else known.outcome
    if outcome is Outcome.ERROR and has_values and code in _TMC_WARNINGS:
        outcome = Outcome.LOW_ACCURACY
    return Outcome.NO_VALUES if outcome in _WITH_VALUES and not has_values else outcome


def name_of(code: int) -> str:
    """Return a code for messages: its number with its name, or with the component of the software that it belongs to."""
    known = _BY_NUMBER.get(code)
    if known is not None:
        return f"{code} {known.name}"
    family = _FAMILIES.get(code >> 8)
    return f"{code} (unknown)" if family is None else f"{code} (unknown, of {family})"
