"""Which parameters of the autopilot a flight without GPS under a roof needs, and why: one manifest for each firmware.

Sources: AUTOPILOTS.md and PX4.md section 3 (PX4 1.18), ARDUPILOT.md (ArduCopter 4.7). `must`: wrong means no arming.
The others are told: the flight works, a failure would go worse.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

Values = Mapping[str, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Expected:
    """One parameter. allowed: values, or None where low and high bound it. bits: must be set. mend: value that
    `--apply` sets. applies: whether it matters with these other values. other_names: as older firmware calls it."""

    name: str
    why: str
    mend: float
    allowed: tuple[float, ...] = ()
    low: float = -math.inf
    high: float = math.inf
    bits: int = 0
    must: bool = False
    needs_reboot: bool = False
    applies: Callable[[Values], bool] = lambda _: True
    other_names: tuple[str, ...] = ()

    def is_met(self, value: float) -> bool:
        if not math.isfinite(value):
            return False
        if self.bits:
            return int(value) & self.bits == self.bits
        if self.allowed:
            return any(math.isclose(value, a, abs_tol=1e-6) for a in self.allowed)
        return self.low - 1e-6 <= value <= self.high + 1e-6

    @property
    def words(self) -> str:
        """What is expected, for people."""
        if self.bits:
            return f"bits {self.bits} set"
        if self.allowed:
            return " or ".join(f"{a:g}" for a in self.allowed)
        if math.isinf(self.high):
            return f"at least {self.low:g}"
        return f"at most {self.high:.9g}" if math.isinf(self.low) else f"{self.low:g} to {self.high:.9g}"

    def mended(self, value: float | None) -> float:
        """What to set: bits are added to those that are there."""
        return float(int(value or 0) | int(self.mend)) if self.bits else self.mend


@dataclass(frozen=True, slots=True, kw_only=True)
class Manifest:
    firmware: str
    known_versions: tuple[str, ...]  # begins of version numbers that these facts were read from
    parameters: tuple[Expected, ...]


def _rc_loss_matters(values: Values) -> bool:
    """NAV_RCL_ACT acts with a transmitter, and as the fallback when COM_OBL_RC_ACT names a manual mode."""
    return values.get("COM_RC_IN_MODE", 0) != 4 or values.get("COM_OBL_RC_ACT", 0) in (0, 1, 2)


PX4_MANIFEST = Manifest(
    firmware="px4",
    known_versions=("1.16", "1.17", "1.18"),
    parameters=(
        Expected(
            name="EKF2_EV_CTRL", bits=9, mend=15, must=True,
            why="the switch for vision: horizontal position (1) and yaw (8); by default all of it is off",
        ),
        Expected(
            name="EKF2_EV_CTRL", bits=15, mend=15,
            why="height (2) and velocity (4) of the vision are worth having too",
        ),
        Expected(
            name="EKF2_SENS_EN", bits=8, mend=8191, must=True, why="bit 3 allows external vision at all (from 1.18)",
        ),
        Expected(
            name="EKF2_HGT_REF", allowed=(3, 0), mend=3, must=True, needs_reboot=True,
            why="height from vision, or the barometer; GPS (1) is not there",
        ),
        Expected(
            name="EKF2_GPS_CTRL", allowed=(0,), mend=0, must=True,
            why="a satellite seen through a roof light would pull the position away",
        ),
        Expected(
            name="SYS_HAS_GPS", allowed=(0,), mend=0, needs_reboot=True, why="else its checks wait for satellites",
        ),
        Expected(
            name="EKF2_MAG_TYPE", allowed=(5,), mend=5, needs_reboot=True,
            why="steel turns the compass; the vision gives the heading",
        ),
        Expected(
            name="COM_ARM_WO_GPS", allowed=(1, 2), mend=2, must=True, why="0 forbids arming without satellites",
        ),
        Expected(
            name="COM_OBL_RC_ACT", allowed=(4, 5), mend=4, must=True,
            why="setpoints lost: land (4) or hold (5); 3 climbs to the return altitude, under a roof; 0 to 2 want a pilot",
        ),
        Expected(
            name="COM_OF_LOSS_T", low=0.3, high=1.5, mend=1.0, must=True,
            why="seconds without setpoints until it acts by itself",
        ),
        Expected(
            name="NAV_RCL_ACT", allowed=(1, 3), mend=3, must=True, applies=_rc_loss_matters,
            why="transmitter lost: 2 (the default) is Return, a climb under a roof",
        ),
        Expected(
            name="NAV_RCL_ACT", allowed=(1, 3), mend=3, why="2 (the default) is Return, a climb under a roof",
            applies=lambda values: not _rc_loss_matters(values),
        ),
        Expected(
            name="NAV_DLL_ACT", allowed=(0, 1, 3), mend=0, must=True,
            why="ground station lost: 2 is Return, a climb under a roof",
        ),
        Expected(
            name="COM_LOW_BAT_ACT", allowed=(2, 3), mend=2,
            why="0 (the default) only warns; the companion turns back first, this is the second layer",
        ),
        Expected(
            name="RTL_RETURN_ALT", high=10.0, mend=5.0,
            why="a fallback can choose Return once an origin is set: it climbs this high, under a roof",
        ),
        Expected(name="GF_MAX_HOR_DIST", low=1.0, mend=500.0, why="0 (the default) is no fence: the second layer is off"),
        Expected(name="GF_MAX_VER_DIST", low=1.0, mend=30.0, why="0 (the default) is no ceiling: the second layer is off"),
        Expected(
            name="EKF2_EV_NOISE_MD", allowed=(0,), mend=0,
            why="1 takes no notice of the covariance that grows between scans",
        ),
        Expected(name="EKF2_EV_QMIN", low=0, high=50, mend=1, why="more than a sound estimate's quality shuts it out"),
        Expected(
            name="EKF2_EV_DELAY", low=0, high=50, mend=0, needs_reboot=True,
            why="our stamps say when the estimate was true: nothing more is to be taken off",
        ),
        Expected(
            name="EKF2_NOAID_TOUT", high=5_000_000, mend=5_000_000,
            why="microseconds of dead reckoning before it gives up: more is more drift",
        ),
        Expected(name="MAV_FWDEXTSP", allowed=(1,), mend=1, must=True, why="0 ignores every offboard setpoint"),
    ),
)  # fmt: skip

ARDUPILOT_MANIFEST = Manifest(
    firmware="ardupilot",
    known_versions=("4.5", "4.6", "4.7"),
    parameters=(
        Expected(name="AHRS_EKF_TYPE", allowed=(3,), mend=3, must=True, why="EKF3 is the one that takes vision"),
        Expected(name="EK3_ENABLE", allowed=(1,), mend=1, must=True, needs_reboot=True, why="EKF3 must run"),
        Expected(name="VISO_TYPE", allowed=(1,), mend=1, must=True, needs_reboot=True,
                 why="the switch for vision by MAVLink; 0 (the default) is off, 2 and 3 are cameras"),
        Expected(name="EK3_SRC1_POSXY", allowed=(6,), mend=6, must=True, why="position from vision (6); GPS is 3"),
        Expected(name="EK3_SRC1_VELXY", allowed=(6, 0), mend=6, must=True, why="velocity from vision (6) or none"),
        Expected(name="EK3_SRC1_POSZ", allowed=(6, 1), mend=6, must=True, why="height from vision (6) or barometer (1)"),
        Expected(name="EK3_SRC1_VELZ", allowed=(6, 0), mend=6, must=True, why="climb rate from vision (6) or none"),
        Expected(name="EK3_SRC1_YAW", allowed=(6,), mend=6, must=True,
                 why="heading from vision (6): steel turns the compass"),
        Expected(name="GPS1_TYPE", allowed=(0,), mend=0, must=True, needs_reboot=True, other_names=("GPS_TYPE",),
                 why="a satellite seen through a roof light would pull the position away"),
        Expected(name="COMPASS_ENABLE", allowed=(0,), mend=0, needs_reboot=True, why="steel turns the compass"),
        Expected(name="FS_EKF_ACTION", allowed=(1, 3), mend=1, must=True,
                 why="vision lost: land (1); 2 (AltHold) waits for a pilot's stick"),
        Expected(name="FS_EKF_THRESH", low=0.5, high=1.0, mend=0.8, why="0 switches that failsafe off"),
        Expected(name="FS_GCS_ENABLE", allowed=(0, 5), mend=5, must=True,
                 why="ground station lost: 1 to 4 and 6 begin with a return, a climb under a roof"),
        Expected(name="FS_GCS_ENABLE", allowed=(5,), mend=5,
                 why="a companion that hangs, or a cable that breaks: land (5) after FS_GCS_TIMEOUT; else blind for 8 s, and "
                     "then 4 s more before it descends, it drifts into a wall (measured)"),
        Expected(name="MAV_GCS_SYSID", low=1, high=250, mend=1, other_names=("SYSID_MYGCS",),
                 why="whose heartbeat FS_GCS_ENABLE watches: the companion's, by the vehicle's own system id; 255 (the "
                     "default) is a ground station, which may be none or go on while the companion hangs"),
        Expected(name="FS_GCS_TIMEOUT", low=2.0, high=3.0, mend=2.0,
                 why="seconds without that heartbeat, which comes once a second: more is more drift"),
        Expected(name="GUID_TIMEOUT", low=0.5, high=1.5, mend=1.0,
                 why="seconds without setpoints until it stops: until then it flies on, 0.4 m in each at 0.43 m/s"),
        Expected(name="RTL_ALT", high=1000, mend=500, other_names=("RTL_ALT_M",),
                 why="centimetres that a return climbs to, under a roof"),
        Expected(name="LAND_ALT_LOW", high=500, mend=300, other_names=("LAND_ALT_LOW_M",),
                 why="centimetres above which it lands fast: landing blind from 9 m it drifts 4 m in 13 s (measured), at "
                     "its default 10 m in 20 s"),
        Expected(name="VISO_QUAL_MIN", low=-1, high=50, mend=0, why="more than a sound estimate's quality shuts it out"),
        Expected(name="VISO_DELAY_MS", low=0, high=50, mend=10,
                 why="our stamps say when the estimate was true: little more is to be taken off"),
        Expected(name="ARMING_CHECK", allowed=(1,), mend=1, why="all of its own checks on"),
    ),
)  # fmt: skip

MANIFESTS = {"px4": PX4_MANIFEST, "ardupilot": ARDUPILOT_MANIFEST}
