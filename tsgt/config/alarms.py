"""Configuration of alarms: events of the master that leave the machine."""

from __future__ import annotations

from typing import Annotated, Literal
from urllib.parse import urlsplit

from pydantic import AfterValidator, Field, model_validator

from tsgt.config.base import Argument, Model, Positive

AlarmName = Literal[
    "station_lost",
    "station_recovered",
    "station_idle",
    "station_measuring",
    "station_not_tracking",
    "station_tracking",
    "instrument_status",
    "battery_low",
    "battery_recovered",
    "layout_residual_high",
    "layout_residual_normal",
    "geofence_exited",
    "geofence_entered",
    "disk_low",
    "disk_full",
    "disk_failed",
    "disk_recovered",
    "radio_failed",
    "radio_recovered",
    "imu_lost",
    "imu_recovered",
    "imu_not_used",
    "imu_used",
    "imu_implausible",
    "imu_plausible",
    "imu_setup_wrong",
    "imu_setup_confirmed",
    "station_contradicted",
    "odometry_lost",
    "odometry_recovered",
    "odometry_disagrees",
    "odometry_agrees",
    "beacon_time_rejected",
    "link_delay_anomaly",
    "other_master",
    "unix_clock_stepped",
    "setup_rejected",
]

DEFAULT_ALARMS: tuple[AlarmName, ...] = (
    "station_lost",
    "battery_low",
    "layout_residual_high",
    "geofence_exited",
    "disk_low",
    "disk_full",
    "disk_failed",
    "radio_failed",
    "imu_not_used",
    "imu_setup_wrong",
    "station_contradicted",
)


def _web_address(text: str) -> str:
    """Reject what is no address of a web server."""
    parts = urlsplit(text)  # ValueError: brackets that do not match
    if parts.scheme not in ("http", "https") or not parts.hostname:
        raise ValueError("is no address of a web server: give https://host/path")
    if parts.port == 0:  # ValueError: no number, or too large
        raise ValueError("has port 0")
    if parts.username is not None or parts.password is not None:
        raise ValueError(
            "has a user or a password, which are not supported: use a key in the path or the query"
        )
    if not text.isascii() or not text.isprintable() or " " in text:
        raise ValueError("has a character that an address cannot have: encode it with %")
    return text


class AlarmsConfig(Model):
    """Alarms: events that leave this machine, through a command, a web server or both."""

    site: Annotated[str, Field(min_length=1, max_length=100)]
    """Name of the site, in each alarm."""
    events: tuple[AlarmName, ...] = DEFAULT_ALARMS
    """Events that are alarms; the events that end them may be added."""
    min_interval_s: Positive = 60.0
    """Minimum time between alarms of the same event and station or geofence; the last one of those in between follows then."""
    command: tuple[Argument, ...] = ()
    """Program and arguments run at each alarm, with the alarm as a JSON line on stdin and TSGT_EVENT, TSGT_SITE, TSGT_MESSAGE
    and TSGT_STATION in its environment."""
    webhook: Annotated[str, AfterValidator(_web_address)] | None = None
    """Address of a web server, http or https, that gets each alarm as a POST request with the JSON line."""

    @model_validator(mode="after")
    def _has_a_target(self) -> AlarmsConfig:
        if not self.command and self.webhook is None:
            raise ValueError("give a command or a webhook, or remove the table")
        return self
