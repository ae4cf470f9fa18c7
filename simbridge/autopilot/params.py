"""Parameters of the emulated PX4 by name, with PX4 1.18's defaults, and how they travel in PARAM_VALUE.

Only those that this emulation acts on, or that a companion or a ground station is likely to ask for. The defaults are
PX4's own; what a vehicle changes is given to `ParamStore` as overrides, as an airframe file does.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator, Mapping

INT32, REAL32, UINT32 = 6, 9, 5  # MAV_PARAM_TYPE
HASH_NAME = "_HASH_CHECK"

_INTS = """
BAT1_N_CELLS 4  BAT1_SOURCE 0  CA_AIRFRAME 0  CA_ROTOR_COUNT 4  CBRK_FLIGHTTERM 121212  CBRK_SUPPLY_CHK 0
COM_ARMABLE 1  COM_ARM_WO_GPS 1  COM_DLL_EXCEPT 0  COM_DL_LOSS_T 10  COM_FLTMODE_BOOT 4  COM_HOME_EN 1
COM_LOW_BAT_ACT 0  COM_MODE_ARM_CHK 1  COM_OBL_RC_ACT 0  COM_POS_LOW_ACT 3  COM_RCL_EXCEPT 0  COM_RC_IN_MODE 3
EKF2_BARO_CTRL 1  EKF2_EN 1  EKF2_EV_CTRL 0  EKF2_EV_NOISE_MD 0  EKF2_EV_QMIN 0  EKF2_GPS_CHECK 2047  EKF2_GPS_CTRL 7
EKF2_GPS_MODE 0  EKF2_HGT_REF 1  EKF2_IMU_CTRL 7  EKF2_MAG_TYPE 0  EKF2_NOAID_TOUT 5000000  EKF2_OF_CTRL 1
EKF2_PREDICT_US 10000  EKF2_RNG_CTRL 1  EKF2_SENS_EN 8191  GF_ACTION 2  GF_SOURCE 0  MAV_COMP_ID 1  MAV_FWDEXTSP 1
MAV_HASH_CHK_EN 1  MAV_PROTO_VER 2  MAV_SYS_ID 1  MAV_TYPE 2  MC_AIRMODE 0  MPC_ACC_DECOUPLE 1  MPC_ALT_MODE 2
MPC_POS_MODE 4  MPC_YAW_MODE 0  NAV_DLL_ACT 0  NAV_RCL_ACT 2  RTL_CONE_ANG 45  RTL_TYPE 0
SENS_EN_BAROSIM 1  SENS_EN_GPSSIM 1  SENS_EN_MAGSIM 1  SYS_AUTOCONFIG 0  SYS_AUTOSTART 10040  SYS_HAS_BARO 1
SYS_HAS_GPS 1  SYS_HAS_MAG 1  SYS_HAS_NUM_DIST 0
"""
_REALS = """
BAT1_CAPACITY -1  BAT1_V_CHARGED 4.05  BAT1_V_EMPTY 3.6  BAT_CRIT_THR 0.07  BAT_EMERGEN_THR 0.05  BAT_LOW_THR 0.15
CA_ROTOR0_KM 0.05  CA_ROTOR0_PX 1  CA_ROTOR0_PY 1  CA_ROTOR1_KM 0.05  CA_ROTOR1_PX -1  CA_ROTOR1_PY -1
CA_ROTOR2_KM -0.05  CA_ROTOR2_PX 1  CA_ROTOR2_PY -1  CA_ROTOR3_KM -0.05  CA_ROTOR3_PX -1  CA_ROTOR3_PY 1
COM_ARM_BAT_MIN -1  COM_DISARM_LAND 2  COM_DISARM_PRFLT 10  COM_FAIL_ACT_T 5  COM_OF_LOSS_T 1  COM_POS_FS_EPH 5
COM_RC_LOSS_T 0.5  COM_SPOOLUP_TIME 1  COM_VEL_FS_EVH 1
EKF2_ACC_B_NOISE 0.003  EKF2_ACC_NOISE 0.35  EKF2_BARO_GATE 5  EKF2_BARO_NOISE 3.5  EKF2_DELAY_MAX 200  EKF2_EVA_NOISE 0.1
EKF2_EVP_GATE 5  EKF2_EVP_NOISE 0.1  EKF2_EVV_GATE 3  EKF2_EVV_NOISE 0.1  EKF2_EV_DELAY 0  EKF2_EV_POS_X 0
EKF2_EV_POS_Y 0  EKF2_EV_POS_Z 0  EKF2_GBIAS_INIT 0.1  EKF2_ABIAS_INIT 0.2  EKF2_ANGERR_INIT 0.1  EKF2_GPS_V_NOISE 0.3
EKF2_GPS_P_NOISE 0.5  EKF2_GYR_B_NOISE 0.001  EKF2_GYR_NOISE 0.015  EKF2_HDG_GATE 2.6  EKF2_HEAD_NOISE 0.3
EKF2_NOAID_NOISE 10  EKF2_TAU_POS 0.25  EKF2_TAU_VEL 0.25
GF_MAX_HOR_DIST 0  GF_MAX_VER_DIST 0  LNDMC_ALT_GND 2  LNDMC_ROT_MAX 20  LNDMC_XY_VEL_MAX 1.5  LNDMC_Z_VEL_MAX 0.25
MC_PITCHRATE_D 0.003  MC_PITCHRATE_I 0.2  MC_PITCHRATE_K 1  MC_PITCHRATE_MAX 220  MC_PITCHRATE_P 0.15  MC_PITCH_P 4
MC_PR_INT_LIM 0.3  MC_ROLLRATE_D 0.003  MC_ROLLRATE_I 0.2  MC_ROLLRATE_K 1  MC_ROLLRATE_MAX 220  MC_ROLLRATE_P 0.15
MC_ROLL_P 4  MC_RR_INT_LIM 0.3  MC_YAWRATE_D 0  MC_YAWRATE_I 0.1  MC_YAWRATE_K 1  MC_YAWRATE_MAX 200  MC_YAWRATE_P 0.2
MC_YAW_P 2.8  MC_YAW_TQ_CUTOFF 2  MC_YAW_WEIGHT 0.4  MC_YR_INT_LIM 0.3  MIS_TAKEOFF_ALT 2.5
MPC_ACC_DOWN_MAX 3  MPC_ACC_HOR 3  MPC_ACC_HOR_MAX 5  MPC_ACC_UP_MAX 4  MPC_JERK_AUTO 4  MPC_JERK_MAX 8  MPC_LAND_ALT1 10
MPC_LAND_ALT2 5  MPC_LAND_ALT3 1  MPC_LAND_CRWL 0.3  MPC_LAND_SPEED 0.7  MPC_THR_HOVER 0.5  MPC_THR_MAX 1
MPC_THR_MIN 0.12  MPC_THR_XY_MARG 0.3  MPC_TILTMAX_AIR 45  MPC_TILTMAX_LND 12  MPC_TKO_RAMP_T 3  MPC_TKO_SPEED 1.5
MPC_VELD_LP 5  MPC_XY_CRUISE 5  MPC_XY_P 0.95  MPC_XY_TRAJ_P 0.5  MPC_XY_VEL_D_ACC 0.2  MPC_XY_VEL_I_ACC 0.4
MPC_XY_VEL_MAX 12  MPC_XY_VEL_P_ACC 1.8  MPC_YAWRAUTO_MAX 60  MPC_Z_P 1  MPC_Z_VEL_D_ACC 0  MPC_Z_VEL_I_ACC 2
MPC_Z_VEL_MAX_DN 1.5  MPC_Z_VEL_MAX_UP 3  MPC_Z_VEL_P_ACC 4  MPC_Z_V_AUTO_DN 1.5  MPC_Z_V_AUTO_UP 3  NAV_ACC_RAD 10
NAV_MC_ALT_RAD 0.8  RTL_DESCEND_ALT 10  RTL_LAND_DELAY 0  RTL_MIN_DIST 10  RTL_RETURN_ALT 30  SIM_BAT_DRAIN 60
SIM_BAT_MIN_PCT 50  THR_MDL_FAC 0
"""


def _table(text: str) -> dict[str, str]:
    words = text.split()
    return dict(zip(words[::2], words[1::2], strict=True))


DEFAULTS: dict[str, int | float] = dict(
    sorted(
        {**{n: int(v) for n, v in _table(_INTS).items()}, **{n: float(v) for n, v in _table(_REALS).items()}}.items()
    )
)
INDEX: dict[str, int] = {name: i for i, name in enumerate(DEFAULTS)}
NAMES: tuple[str, ...] = tuple(DEFAULTS)


def wire_type(name: str) -> int:
    """MAV_PARAM_TYPE of a known parameter."""
    return INT32 if isinstance(DEFAULTS[name], int) else REAL32


def to_float(value: int | float) -> float:
    """What PARAM_VALUE.param_value carries: reals as they are, integers bytewise."""
    if isinstance(value, int):
        return float(struct.unpack("<f", struct.pack("<i", value))[0])
    return value


def from_float(raw: float, kind: int) -> int | float:
    """Inverse of `to_float` for INT32 and REAL32."""
    if kind == INT32:
        return int(struct.unpack("<i", struct.pack("<f", raw))[0])
    return raw


class ParamStore:
    """Values by name. `version` grows with each change, so that users can cache what they derive from it."""

    def __init__(self, overrides: Mapping[str, float]) -> None:
        """overrides: what the airframe sets over the defaults.

        Raises: ValueError: a name this emulation does not carry, or a value that is not of the parameter's type.
        """
        self._values: dict[str, int | float] = dict(DEFAULTS)
        self.version = 0
        for name, value in overrides.items():
            if name not in DEFAULTS:
                raise ValueError(f"parameter {name}: not one of the {len(DEFAULTS)} that the emulated PX4 carries")
            if not math.isfinite(value) or (wire_type(name) == INT32 and value != int(value)):
                raise ValueError(f"parameter {name}: expected {_kind(name)}, got {value!r}")
            self.set(name, value)
        self.changed_at_boot: tuple[str, ...] = tuple(n for n in NAMES if n in overrides)

    def __contains__(self, name: str) -> bool:
        return name in self._values

    def __iter__(self) -> Iterator[str]:
        return iter(NAMES)

    def real(self, name: str) -> float:
        return float(self._values[name])

    def integer(self, name: str) -> int:
        return int(self._values[name])

    def value(self, name: str) -> int | float:
        return self._values[name]

    def set(self, name: str, value: float) -> None:
        self._values[name] = (
            int(value) if wire_type(name) == INT32 else struct.unpack("<f", struct.pack("<f", value))[0]
        )
        self.version += 1

    def hash(self) -> int:
        """CRC-32 over names and values, as the ground stations' cache check wants it."""
        crc = 0
        for name in NAMES:
            value = self._values[name]
            raw = struct.pack("<i", value) if isinstance(value, int) else struct.pack("<f", value)
            crc = zlib.crc32(raw, zlib.crc32(name.encode(), crc))
        return crc


def _kind(name: str) -> str:
    return "a whole number" if wire_type(name) == INT32 else "a finite number"
