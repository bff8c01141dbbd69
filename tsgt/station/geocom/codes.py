"""What the return codes of GeoCOM mean to somebody who tracks a prism.

Source: Leica, TPS1200 GeoCOM Reference Manual, version 1.20, appendix A and chapter TMC; codes of newer instruments from
GeoComPy 1.0. Older manuals have other names for the same numbers. In the EDM family 769 to 774 changed their meaning
between generations: nothing depends on them.
"""

from __future__ import annotations

from enum import Enum, IntEnum, auto
from typing import Final


class ReturnCode(IntEnum):
    """The codes that a tracking client can meet, by the names of the manual."""

    OK = 0
    UNDEFINED = 1
    IVPARAM = 2
    IVRESULT = 3
    FATAL = 4
    NOT_IMPL = 5
    TIME_OUT = 6
    SET_INCOMPL = 7
    ABORT = 8
    NOMEMORY = 9
    NOTINIT = 10
    SHUT_DOWN = 12
    SYSBUSY = 13
    HWFAILURE = 14
    ABORT_APPL = 15
    LOW_POWER = 16
    IVVERSION = 17
    BATT_EMPTY = 18
    NO_EVENT = 20
    OUT_OF_TEMP = 21
    INSTRUMENT_TILT = 22
    COM_SETTING = 23
    NO_ACTION = 24
    SLEEP_MODE = 25
    NOTOK = 26
    NA = 27
    OVERFLOW = 28
    STOPPED = 29

    ANG_ERROR = 257
    ANG_INCL_ERROR = 258
    ANG_BAD_ACC = 259
    ANG_BAD_ANGLE_ACC = 260
    ANG_BAD_INCLIN_ACC = 261
    ANG_OUT_OF_RANGE = 267
    ANG_HZ_MOVED = 269

    ATA_NOT_READY = 512
    ATA_NO_RESULT = 513
    ATA_SEVERAL_TARGETS = 514
    ATA_BIG_SPOT = 515
    ATA_BACKGROUND = 516
    ATA_NO_TARGETS = 517
    ATA_NOT_ACCURAT = 518
    ATA_SPOT_ON_EDGE = 519
    ATA_BLOOMING = 522
    ATA_NOT_BUSY = 523
    ATA_STRANGE_LIGHT = 524
    ATA_PS_NOT_READY = 538
    ATA_ATR_SYSTEM_ERR = 539

    EDM_COMERR = 769
    EDM_TIMEOUT = 775
    EDM_FLUKT_ERR = 776
    EDM_FMOT_ERR = 777
    EDM_DEV_NOT_INSTALLED = 778
    EDM_NOT_FOUND = 779
    EDM_ERROR_RECEIVED = 780
    EDM_INTERNAL_ERR = 785
    EDM_BUSY = 786
    EDM_NO_MEASACTIVITY = 787
    EDM_INIT_OR_STOP_ERR = 789
    EDM_MEAS_ABORTED = 791
    EDM_DISTRANGE_ERR = 818
    EDM_SIGNTONOISE_ERR = 819
    EDM_NOISEHIGH_ERR = 820
    EDM_MULTRG_ERR = 823
    EDM_MEAS_DIST_NOT_ALLOWED = 826
    EDM_DIST_TOO_SHORT = 829

    TMC_NO_FULL_CORRECTION = 1283
    TMC_ACCURACY_GUARANTEE = 1284
    TMC_ANGLE_OK = 1285
    TMC_ANGLE_NOT_FULL_CORR = 1288
    TMC_ANGLE_NO_ACC_GUARANTY = 1289
    TMC_ANGLE_ERROR = 1290
    TMC_DIST_PPM = 1291
    TMC_DIST_ERROR = 1292
    TMC_BUSY = 1293
    TMC_SIGNAL_ERROR = 1294
    TMC_OLD_PLANE = 1380
    TMC_NO_PLANE = 1381
    TMC_INCLINE_ACC = 1383

    MOT_UNREADY = 1792
    MOT_BUSY = 1793
    MOT_NOT_OCONST = 1794
    MOT_NOT_CONFIG = 1795
    MOT_NOT_POSIT = 1796
    MOT_NOT_BUSY = 1798
    MOT_NOT_LOCK = 1799
    MOT_HZ_MOTOR_ERROR = 1804
    MOT_V_MOTOR_ERROR = 1805
    MOT_TIMEOUT = 1806

    BMM_XFER_PENDING = 2305
    BMM_NOT_INSTALLED = 2308

    COM_ERO = 3072
    COM_CANT_ENCODE = 3073
    COM_CANT_DECODE = 3074
    COM_CANT_SEND = 3075
    COM_CANT_RECV = 3076
    COM_TIMEDOUT = 3077
    COM_WRONG_FORMAT = 3078
    COM_VER_MISMATCH = 3079
    COM_CANT_DECODE_REQ = 3080
    COM_PROC_UNAVAIL = 3081
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
    COM_CONS_REQ = 3107
    COM_SRVR_IS_SLEEPING = 3108
    COM_SRVR_IS_OFF = 3109
    COM_NO_CHECKSUM = 3110

    AUT_TIMEOUT = 8704
    AUT_DETENT_ERROR = 8705
    AUT_ANGLE_ERROR = 8706
    AUT_MOTOR_ERROR = 8707
    AUT_INCACC = 8708
    AUT_DEV_ERROR = 8709
    AUT_NO_TARGET = 8710
    AUT_MULTIPLE_TARGETS = 8711
    AUT_BAD_ENVIRONMENT = 8712
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
    AUT_NO_LOCK = 8725

    BAP_CHANGE_ALL_TO_DIST = 9217
    KDM_NOT_AVAILABLE = 12_544
    FTR_FILEACCESS = 13_056


class Verdict(Enum):
    """What a code means for whoever asked."""

    USABLE = auto()
    """Done, or measured; a warning about the battery too."""
    LOW_ACCURACY = auto()
    """Distance and angles are valid, but some correction is missing or not sure: usual while the telescope turns."""
    ANGLE_ONLY = auto()
    """The angles are valid, there is no distance."""
    NO_TARGET = auto()
    """No prism is seen, or no distance can be measured to it."""
    TILT = auto()
    """Nothing is valid, as a rule because the instrument is not level."""
    WRONG_DISTANCE = auto()
    """The distance cannot be used because of what is set in the instrument for its correction."""
    BUSY = auto()
    """Something is under way, or a distance is still stored: again later, or after clearing."""
    ASLEEP = auto()
    """It sleeps or is off, and wakes up when it is spoken to."""
    LICENCE = auto()
    """It may not do this: the licence GeoCOM Robotic is missing."""
    UNAVAILABLE = auto()
    """It cannot do this: no such procedure, or no such part."""
    SHUT_DOWN = auto()
    """It is switching off."""
    NOTHING = auto()
    """The code speaks of values, and none came."""
    ERROR = auto()
    """It did not do it."""


_WITH_VALUES: Final = frozenset({Verdict.LOW_ACCURACY, Verdict.ANGLE_ONLY})

_BY_CODE: Final = {
    int(code): verdict
    for verdict, codes in {
        Verdict.USABLE: (ReturnCode.OK, ReturnCode.LOW_POWER, ReturnCode.BATT_EMPTY),
        Verdict.LOW_ACCURACY: (ReturnCode.TMC_NO_FULL_CORRECTION, ReturnCode.TMC_ACCURACY_GUARANTEE),
        Verdict.ANGLE_ONLY: (
            ReturnCode.TMC_ANGLE_OK,
            ReturnCode.TMC_ANGLE_NOT_FULL_CORR,
            ReturnCode.TMC_ANGLE_NO_ACC_GUARANTY,
        ),
        Verdict.NO_TARGET: (
            ReturnCode.ATA_NO_RESULT,
            ReturnCode.ATA_SEVERAL_TARGETS,
            ReturnCode.ATA_BIG_SPOT,
            ReturnCode.ATA_BACKGROUND,
            ReturnCode.ATA_NO_TARGETS,
            ReturnCode.ATA_NOT_ACCURAT,
            ReturnCode.ATA_SPOT_ON_EDGE,
            ReturnCode.ATA_BLOOMING,
            ReturnCode.ATA_STRANGE_LIGHT,
            ReturnCode.EDM_TIMEOUT,
            ReturnCode.EDM_FLUKT_ERR,
            ReturnCode.EDM_NO_MEASACTIVITY,
            ReturnCode.EDM_DISTRANGE_ERR,
            ReturnCode.EDM_SIGNTONOISE_ERR,
            ReturnCode.EDM_NOISEHIGH_ERR,
            ReturnCode.EDM_MULTRG_ERR,
            ReturnCode.EDM_DIST_TOO_SHORT,
            ReturnCode.TMC_DIST_ERROR,
            ReturnCode.MOT_NOT_LOCK,
            ReturnCode.AUT_NO_TARGET,
            ReturnCode.AUT_MULTIPLE_TARGETS,
            ReturnCode.AUT_BAD_ENVIRONMENT,
            ReturnCode.AUT_NO_LOCK,
        ),
        Verdict.TILT: (ReturnCode.INSTRUMENT_TILT, ReturnCode.ANG_INCL_ERROR, ReturnCode.TMC_ANGLE_ERROR),
        Verdict.WRONG_DISTANCE: (ReturnCode.TMC_DIST_PPM,),
        Verdict.BUSY: (
            ReturnCode.SYSBUSY,
            ReturnCode.ATA_NOT_READY,
            ReturnCode.ATA_PS_NOT_READY,
            ReturnCode.EDM_BUSY,
            ReturnCode.TMC_BUSY,
            ReturnCode.MOT_BUSY,
            ReturnCode.COM_CONS_REQ,
        ),
        Verdict.ASLEEP: (
            ReturnCode.SLEEP_MODE,
            ReturnCode.COM_SRVR_IS_SLEEPING,
            ReturnCode.COM_SRVR_IS_OFF,
        ),
        Verdict.LICENCE: (ReturnCode.NA,),
        Verdict.UNAVAILABLE: (
            ReturnCode.NOT_IMPL,
            ReturnCode.EDM_DEV_NOT_INSTALLED,
            ReturnCode.BMM_NOT_INSTALLED,
            ReturnCode.COM_PROC_UNAVAIL,
            ReturnCode.COM_NO_CHECKSUM,
            ReturnCode.KDM_NOT_AVAILABLE,
        ),
        Verdict.SHUT_DOWN: (ReturnCode.SHUT_DOWN,),
    }.items()
    for code in codes
}

_TMC_WARNINGS: Final = frozenset(range(1280, 1400)) - {ReturnCode.TMC_SIGNAL_ERROR}
"""Where newer firmware has warnings that no manual at hand lists."""

_FAMILIES: Final = {
    0: "TPS",
    1: "ANG",
    2: "ATA",
    3: "EDM",
    4: "GMF",
    5: "TMC",
    6: "MEM",
    7: "MOT",
    8: "LDR",
    9: "BMM",
    10: "TXT",
    11: "MMI",
    12: "COM",
    13: "DPL",
    15: "FIL",
    19: "DPL",
    20: "WIR",
    34: "AUT",
    36: "BAP",
    37: "SAP",
    38: "COD",
    39: "BAS",
    40: "IOS",
    41: "CNF",
    47: "DNA",
    49: "KDM",
    51: "FTR",
    54: "CAM",
}
"""The parts of the instrument's software, by the high byte of their codes."""

_NAMES: Final = {int(code): code.name for code in ReturnCode}


def verdict(code: int, *, has_values: bool) -> Verdict:
    """Return what a code means.

    Parameters
    ----------
    code
        From a reply.
    has_values
        Whether the reply has values. A code that says that some are valid is :attr:`Verdict.NOTHING` without.
    """
    found = _BY_CODE.get(code, Verdict.ERROR)
    if found is Verdict.ERROR and has_values and code in _TMC_WARNINGS:
        found = Verdict.LOW_ACCURACY
    return Verdict.NOTHING if found in _WITH_VALUES and not has_values else found


def name_of(code: int) -> str:
    """Return a code for people: its number, with its name, or else with the part of the software that it is from."""
    name = _NAMES.get(code)
    if name is not None:
        return f"{code} {name}"
    family = _FAMILIES.get(code >> 8)
    return f"{code} (unknown)" if family is None else f"{code} (unknown, of {family})"
