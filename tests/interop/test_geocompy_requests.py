"""Our requests equal those of GeoComPy 1.0, an independent client, byte for byte; each difference has its reason."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import datetime
from typing import Any

import geocompy.geo
import pytest
from geocompy.communication import Connection, crc16_bitwise
from geocompy.data import Byte as TheirByte
from geocompy.data import Coordinate
from geocompy.geo import GeoCom
from geocompy.geo.gctypes import GeoComCode, rpcnames

from tsgt.station.geocom import Parameter, ReturnCode, Rpc
from tsgt.station.geocom.codec import Byte, decode_reply, encode_request


class Wire(Connection):
    """A line that records requests and responds to each with success."""

    def __init__(self) -> None:
        self.sent: list[str] = []

    def is_open(self) -> bool:
        """Return True."""
        return True

    def send(self, message: str) -> None:
        """Accept a request without response."""
        self.sent.append(message)

    def send_binary(self, data: bytes) -> None:
        """Not used."""
        raise NotImplementedError

    def receive(self) -> str:
        """Not used."""
        raise NotImplementedError

    def receive_binary(self) -> bytes:
        """Not used."""
        raise NotImplementedError

    def exchange(self, cmd: str) -> str:
        """Accept a request and respond."""
        self.sent.append(cmd)
        transaction = cmd.partition(":")[0].split(",")[2]
        return f"%R1P,0,{transaction}:0"

    def exchange_binary(self, data: bytes) -> bytes:
        """Not used."""
        raise NotImplementedError

    def close(self) -> None:
        """Do nothing."""

    def reset(self) -> None:
        """Do nothing."""


@pytest.fixture
def wire(monkeypatch: pytest.MonkeyPatch) -> Wire:
    """Make a line; GeoComPy's initial pause is skipped."""
    monkeypatch.setattr(geocompy.geo, "sleep", lambda _: None)
    return Wire()


Request = tuple[Callable[[GeoCom], object], Rpc, tuple[Parameter, ...]]

SAME: list[Request] = [
    (lambda g: g.com.nullprocess(), Rpc.COM_NULL_PROC, ()),
    (lambda g: g.com.set_double_precision(10), Rpc.COM_SET_DOUBLE_PRECISION, (10,)),
    (lambda g: g.com.get_double_precision(), Rpc.COM_GET_DOUBLE_PRECISION, ()),
    (lambda g: g.com.get_geocom_version(), Rpc.COM_GET_SW_VERSION, ()),
    (lambda g: g.com.switch_on(), Rpc.COM_SWITCH_ON_TPS, (1,)),
    (lambda g: g.com.switch_off(), Rpc.COM_SWITCH_OFF_TPS, (0,)),
    (lambda g: g.csv.get_instrument_name(), Rpc.CSV_GET_INSTRUMENT_NAME, ()),
    (lambda g: g.csv.get_serial_number(), Rpc.CSV_GET_INSTRUMENT_NO, ()),
    (lambda g: g.csv.get_firmware_version(), Rpc.CSV_GET_SW_VERSION, ()),
    (lambda g: g.csv.get_instrument_configuration(), Rpc.CSV_GET_DEVICE_CONFIG, ()),
    (lambda g: g.csv.get_datetime(), Rpc.CSV_GET_DATE_TIME, ()),
    (lambda g: g.csv.get_datetime_precise(), Rpc.CSV_GET_DATE_TIME_CENTI_SEC, ()),
    (lambda g: g.csv.get_internal_temperature(), Rpc.CSV_GET_INT_TEMP, ()),
    (lambda g: g.csv.get_reflectorless_class(), Rpc.CSV_GET_REFLECTORLESS_CLASS, ()),
    (lambda g: g.csv.check_power(), Rpc.CSV_CHECK_POWER, ()),
    (lambda g: g.edm.switch_laserpointer(True), Rpc.EDM_LASERPOINTER, (True,)),
    (lambda g: g.edm.get_guidelight_intensity(), Rpc.EDM_GET_EGL_INTENSITY, ()),
    (lambda g: g.edm.set_guidelight_intensity("HIGH"), Rpc.EDM_SET_EGL_INTENSITY, (3,)),
    (lambda g: g.tmc.get_angle_inclination("AUTO"), Rpc.TMC_GET_ANGLE1, (1,)),
    (lambda g: g.tmc.get_angle("MODEL"), Rpc.TMC_GET_ANGLE5, (2,)),
    (lambda g: g.tmc.get_simple_measurement(1), Rpc.TMC_GET_SIMPLE_MEA, (1000, 1)),
    (lambda g: g.tmc.get_complete_measurement(2, "AUTO"), Rpc.TMC_GET_FULL_MEAS, (2000, 1)),
    (lambda g: g.tmc.get_coordinate(3), Rpc.TMC_GET_COORDINATE, (3000, 1)),
    (lambda g: g.tmc.get_simple_coordinate(1), Rpc.TMC_GET_SIMPLE_COORD, (1000, 1)),
    (lambda g: g.tmc.quick_distance(), Rpc.TMC_QUICK_DIST, ()),
    (lambda g: g.tmc.do_measurement("CLEAR"), Rpc.TMC_DO_MEASURE, (3, 1)),
    (lambda g: g.tmc.do_measurement("DISTANCE"), Rpc.TMC_DO_MEASURE, (1, 1)),
    (lambda g: g.tmc.switch_compensator(True), Rpc.TMC_SET_INCLINE_SWITCH, (True,)),
    (lambda g: g.tmc.get_compensator_status(), Rpc.TMC_GET_INCLINE_SWITCH, ()),
    (
        lambda g: g.tmc.set_angle_correction(True, True, False, True),
        Rpc.TMC_SET_ANG_SWITCH,
        (True, True, False, True),
    ),
    (lambda g: g.tmc.get_angle_correction(), Rpc.TMC_GET_ANG_SWITCH, ()),
    (lambda g: g.tmc.set_edm_mode_v2("CONT_FAST"), Rpc.TMC_SET_EDM_MODE, (9,)),
    (lambda g: g.tmc.set_edm_mode_v2("SINGLE_TAPE"), Rpc.TMC_SET_EDM_MODE, (1,)),
    (lambda g: g.tmc.get_edm_mode_v2(), Rpc.TMC_GET_EDM_MODE, ()),
    (lambda g: g.tmc.set_prism_correction(0.0175), Rpc.TMC_SET_PRISM_CORR, (0.0175,)),
    (lambda g: g.tmc.set_prism_correction(-0.0344), Rpc.TMC_SET_PRISM_CORR, (-0.0344,)),
    (lambda g: g.tmc.get_prism_correction(), Rpc.TMC_GET_PRISM_CORR, ()),
    (lambda g: g.tmc.get_distance_correction(), Rpc.TMC_GET_SLOPE_DIST_CORR, ()),
    (lambda g: g.tmc.get_atmospheric_corrections(), Rpc.TMC_GET_ATM_CORR, ()),
    (lambda g: g.tmc.set_atmospheric_correction_ppm(8.5), Rpc.TMC_SET_ATM_PPM, (8.5,)),
    (lambda g: g.tmc.get_atmospheric_correction_ppm(), Rpc.TMC_GET_ATM_PPM, ()),
    (lambda g: g.tmc.get_geometric_correction_ppm(), Rpc.TMC_GET_GEO_PPM, ()),
    (
        lambda g: g.tmc.set_refractive_correction(True, 6_378_000.0, 0.13),
        Rpc.TMC_SET_REFRACTIVE_CORR,
        (True, 6_378_000.0, 0.13),
    ),
    (lambda g: g.tmc.get_refractive_correction(), Rpc.TMC_GET_REFRACTIVE_CORR, ()),
    (
        lambda g: g.tmc.set_station(Coordinate(1.5, -2.25, 0.0), 1.7),
        Rpc.TMC_SET_STATION,
        (1.5, -2.25, 0.0, 1.7),
    ),
    (lambda g: g.tmc.get_station(), Rpc.TMC_GET_STATION, ()),
    (lambda g: g.tmc.set_azimuth(1.25), Rpc.TMC_SET_ORIENTATION, (1.25,)),
    (lambda g: g.tmc.get_face(), Rpc.TMC_GET_FACE, ()),
    (lambda g: g.tmc.was_not_atr_corrected(), Rpc.TMC_IF_DATA_AZE_CORR_ERROR, ()),
    (lambda g: g.tmc.was_not_inclination_corrected(), Rpc.TMC_IF_DATA_INC_CORR_ERROR, ()),
    (lambda g: g.mot.get_lockon_status(), Rpc.MOT_READ_LOCK_STATUS, ()),
    (lambda g: g.aus.switch_user_atr(True), Rpc.AUS_SET_USER_ATR_STATE, (True,)),
    (lambda g: g.aus.get_user_atr_state(), Rpc.AUS_GET_USER_ATR_STATE, ()),
    (lambda g: g.aus.switch_user_lock(False), Rpc.AUS_SET_USER_LOCK_STATE, (False,)),
    (lambda g: g.aus.get_user_lock_state(), Rpc.AUS_GET_USER_LOCK_STATE, ()),
    (lambda g: g.aut.lock_in(), Rpc.AUT_LOCK_IN, ()),
    (lambda g: g.aut.turn_to(1.5, 1.625), Rpc.AUT_MAKE_POSITIONING, (1.5, 1.625, 0, 0, False)),
    (lambda g: g.aut.change_face(), Rpc.AUT_CHANGE_FACE, (0, 0, False)),
    (lambda g: g.aut.fine_adjust(0.0872, 0.0872), Rpc.AUT_FINE_ADJUST, (0.0872, 0.0872, False)),
    (lambda g: g.aut.search(0.5, 0.25), Rpc.AUT_SEARCH, (0.5, 0.25, False)),
    (lambda g: g.aut.set_fine_adjust_mode("POINT"), Rpc.AUT_SET_FINE_ADJUST_MODE, (1,)),
    (lambda g: g.aut.get_fine_adjust_mode(), Rpc.AUT_GET_FINE_ADJUST_MODE, ()),
    (
        lambda g: g.aut.set_search_area(1.0, 1.5, 0.75, 0.25, enabled=True),
        Rpc.AUT_SET_SEARCH_AREA,
        (1.0, 1.5, 0.75, 0.25, True),
    ),
    (lambda g: g.aut.get_search_area(), Rpc.AUT_GET_SEARCH_AREA, ()),
    (lambda g: g.aut.set_spiral(0.5, 0.25), Rpc.AUT_SET_USER_SPIRAL, (0.5, 0.25)),
    (lambda g: g.aut.get_spiral(), Rpc.AUT_GET_USER_SPIRAL, ()),
    (lambda g: g.aut.set_powersearch_range(1, 400), Rpc.AUT_PS_SET_RANGE, (1, 400)),
    (lambda g: g.aut.switch_powersearch_range(True), Rpc.AUT_PS_ENABLE_RANGE, (True,)),
    (lambda g: g.aut.powersearch_window(), Rpc.AUT_PS_SEARCH_WINDOW, ()),
    (
        lambda g: g.aut.powersearch_next("COUNTERCLOCKWISE", swing=True),
        Rpc.AUT_PS_SEARCH_NEXT,
        (-1, True),
    ),
    (lambda g: g.aut.get_tolerance(), Rpc.AUT_READ_TOL, ()),
    (lambda g: g.aut.set_timeout(15.0, 15.0), Rpc.AUT_SET_TIMEOUT, (15.0, 15.0)),
    (lambda g: g.aut.get_timeout(), Rpc.AUT_READ_TIMEOUT, ()),
    (lambda g: g.bap.set_prism_type("MINI360"), Rpc.BAP_SET_PRISM_TYPE, (7,)),
    (lambda g: g.bap.get_prism_type(), Rpc.BAP_GET_PRISM_TYPE, ()),
    (lambda g: g.bap.get_prism_definition("ROUND"), Rpc.BAP_GET_PRISM_DEF, (0,)),
    (lambda g: g.bap.set_prism_type_name("USER", "tsgt"), Rpc.BAP_SET_PRISM_TYPE2, (9, "tsgt")),
    (lambda g: g.bap.get_prism_type_name(), Rpc.BAP_GET_PRISM_TYPE2, ()),
    (
        lambda g: g.bap.set_user_prism_definition("tsgt", 0.01, "PRISM", "us, them"),
        Rpc.BAP_SET_USER_PRISM_DEF,
        ("tsgt", 0.01, 1, "us, them"),
    ),
    (lambda g: g.bap.get_user_prism_definition("tsgt"), Rpc.BAP_GET_USER_PRISM_DEF, ("tsgt",)),
    (lambda g: g.bap.set_target_type("REFLECTOR"), Rpc.BAP_SET_TARGET_TYPE, (0,)),
    (lambda g: g.bap.get_target_type(), Rpc.BAP_GET_TARGET_TYPE, ()),
    (lambda g: g.bap.set_measurement_program("CONT_REF_SYNCHRO"), Rpc.BAP_SET_MEAS_PRG, (10,)),
    (lambda g: g.bap.get_measurement_program(), Rpc.BAP_GET_MEAS_PRG, ()),
    (lambda g: g.bap.measure_distance_angle(), Rpc.BAP_MEAS_DISTANCE_ANGLE, (2,)),
    (lambda g: g.bap.search_target(), Rpc.BAP_SEARCH_TARGET, (False,)),
    (lambda g: g.bap.set_atr_setting("NORMAL"), Rpc.BAP_SET_ATR_SETTING, (0,)),
    (lambda g: g.bap.switch_reduced_atr_fov(True), Rpc.BAP_SET_RED_ATR_FOV, (True,)),
    (lambda g: g.bap.get_reduced_atr_fov_status(), Rpc.BAP_GET_RED_ATR_FOV, ()),
    (
        lambda g: g.sup.set_poweroff_configuration(False, "DISABLED", 600_000),
        Rpc.SUP_SET_CONFIG,
        (False, 0, 600_000),
    ),
    (lambda g: g.sup.get_poweroff_configuration(), Rpc.SUP_GET_CONFIG, ()),
    (lambda g: g.bmm.beep_normal(), Rpc.BMM_BEEP_NORMAL, ()),
    (lambda g: g.bmm.beep_alarm(), Rpc.BMM_BEEP_ALARM, ()),
]

OTHER: list[tuple[Request, str, str, str]] = [
    (
        (lambda g: g.tmc.set_azimuth(1.2345678901), Rpc.TMC_SET_ORIENTATION, (1.2345678901,)),
        "1.234568",
        "1.2345678901",
        "it sends six decimals at most, whatever precision was agreed on",
    ),
    (
        (
            lambda g: g.tmc.set_atmospheric_corrections(6.58e-7, 1013.25, 12.0, 9.0),
            Rpc.TMC_SET_ATM_CORR,
            (6.58e-7, 1013.25, 12.0, 9.0),
        ),
        "0.000001,1013.25,12.0,9.0",
        "0.000000658,1013.25,12.0,9.0",
        "the same: the wavelength is off by half",
    ),
    (
        (lambda g: g.aut.set_tolerance(1.57e-6, 1.57e-6), Rpc.AUT_SET_TOL, (1.57e-6, 1.57e-6)),
        "0.000002,0.000002",
        "0.00000157,0.00000157",
        "the same",
    ),
    (
        (
            lambda g: g.bap.get_user_prism_definition('5" mini'),
            Rpc.BAP_GET_USER_PRISM_DEF,
            ('5" mini',),
        ),
        '"5" mini"',
        '"5\\x22 mini"',
        "it does not escape what would end a text early",
    ),
]


def ours(line: str, rpc: Rpc, parameters: Sequence[Parameter], *, checksum: bool = False) -> str:
    """Encode the same request with their transaction number."""
    transaction = int(line.partition(":")[0].split(",")[2])
    encoded = encode_request(rpc, parameters, transaction=transaction, checksum=checksum, decimals=15)
    assert encoded.endswith(b"\r\n")
    return encoded[:-2].decode("ascii")


@pytest.mark.parametrize("checksum", [False, True])
def test_requests_are_equal(wire: Wire, checksum: bool) -> None:  # noqa: FBT001 (a parameter of pytest)
    """Number, order and form of parameters are equal byte for byte, with and without checksums."""
    client = GeoCom(wire, checksum=checksum)
    for call, rpc, parameters in SAME:
        call(client)
        assert wire.sent[-1] == ours(wire.sent[-1], rpc, parameters, checksum=checksum)


@pytest.mark.parametrize(("request_", "theirs", "own", "why"), OTHER)
def test_known_differences_of_requests(
    wire: Wire, request_: Request, theirs: str, own: str, why: str
) -> None:
    """Each known difference has its reason; the deviation is GeoComPy's."""
    call, rpc, parameters = request_
    call(GeoCom(wire))
    line = wire.sent[-1]
    assert line.split(":", 1)[1] == theirs, why
    assert ours(line, rpc, parameters).split(":", 1)[1] == own


def test_byte_parameters_are_equal(wire: Wire) -> None:
    """A date is sent as bytes."""
    GeoCom(wire).csv.set_datetime(datetime(2026, 11, 21, 12, 34, 56))  # noqa: DTZ001 (theirs have no zone)
    expected = encode_request(
        5007,
        (2026, *map(Byte, (11, 21, 12, 34, 56))),
        transaction=int(wire.sent[-1].split(",")[2].split(":")[0]),
    )
    assert wire.sent[-1].encode() + b"\r\n" == expected
    assert str(TheirByte(0x2F)) == "'2F'"


@pytest.mark.parametrize("checksum", [False, True])
@pytest.mark.parametrize(
    "line",
    [
        "%R1P,0,1:0,1.5,0.25,1.0e-5,42.125,123456",
        "%R1P,0,2:1284,1.5,0.25,1.0e-5,42.125,123456",
        "%R1P,0,3:27",
        "%R1P,3081,4:0",
    ],
)
def test_responses_decode_equally(
    wire: Wire,
    line: str,
    checksum: bool,  # noqa: FBT001 (a parameter of pytest)
) -> None:
    """Return codes and values, with and without checksums."""
    client = GeoCom(wire, checksum=checksum)
    if checksum:
        head, body = line.split(":")
        line = f"{head},{crc16_bitwise(line)}:{body}"
    transaction = int(line.split(",")[2].split(":")[0])
    parsers: list[Callable[[str], Any]] = [float] * 5 if "123456" in line else []
    theirs = client.parse_response(f"%R1Q,2167,{transaction}:", line, parsers)
    reply = decode_reply(line.encode(), checksum=checksum)
    assert (reply.com_code or reply.code) == int(theirs.error)
    assert reply.transaction == transaction
    assert reply.values == (theirs.params or ())


def test_rpc_names_are_equal() -> None:
    """RPC numbers that both know have the same names, apart from spelling."""
    for rpc in Rpc:
        theirs = rpcnames.get(rpc)
        if theirs is not None:
            assert rpc.name.replace("_", "") == theirs.upper().replace("_", ""), rpc


def test_return_code_names_are_equal() -> None:
    """Return codes have the same names, except two that newer manuals spell differently."""
    theirs = {int(code): code.name for code in GeoComCode}
    different = {code.name for code in ReturnCode if theirs.get(code, code.name) != code.name}
    assert different == {"TMC_ANGLE_NOT_FULL_CORR", "TMC_ANGLE_NO_ACC_GUARANTY"}
