"""Parameters with which real PX4 and ArduCopter fly without GPS in a simulation: what differs from their defaults.

Sources: VEHICLE measurements (flown with stock gains), PX4 1.18 section 3, the recorded conversations. `stockpilot
doctor` holds the same against a vehicle, with the reasons; what is only for a simulation stands apart here.
"""

from __future__ import annotations

Parameters = dict[str, float]

PX4_VISION: Parameters = {
    "EKF2_EV_CTRL": 15,  # position, height, velocity, yaw
    "EKF2_EV_DELAY": 0,
    "EKF2_HGT_REF": 3,  # vision
    "EKF2_GPS_CTRL": 0,
    "EKF2_MAG_TYPE": 5,  # none: steel silos
    "SYS_HAS_GPS": 0,
    "COM_ARM_WO_GPS": 2,
    "COM_RC_IN_MODE": 4,
    "COM_OBL_RC_ACT": 4,  # setpoints lost: land, never climb under a roof
    "NAV_DLL_ACT": 0,
    "NAV_RCL_ACT": 3,  # land, not return
}
PX4_HALL: Parameters = {
    "RTL_RETURN_ALT": 5,  # metres: no climb under a roof
    "GF_MAX_HOR_DIST": 500,
    "GF_MAX_VER_DIST": 30,
}
PX4_SIMULATION: Parameters = {
    "SIM_BAT_DRAIN": 0,  # else the simulated battery is flat after a minute
    "THR_MDL_FAC": 0.65,  # the vehicle's thrust law
    # Its arms, instead of those of the Iris.
    **{f"CA_ROTOR{i}_P{axis}": value for i, (x, y) in enumerate(((1, 1), (-1, -1), (1, -1), (-1, 1)))
       for axis, value in (("X", 0.2 * x), ("Y", 0.2 * y))},
}  # fmt: skip

ARDUPILOT_VISION: Parameters = {
    "AHRS_EKF_TYPE": 3,
    "EK2_ENABLE": 0,
    "EK3_ENABLE": 1,
    "EK3_SRC1_POSXY": 6,
    "EK3_SRC1_VELXY": 6,
    "EK3_SRC1_POSZ": 6,
    "EK3_SRC1_VELZ": 6,
    "EK3_SRC1_YAW": 6,
    "VISO_TYPE": 1,
    "VISO_DELAY_MS": 10,
    "GPS1_TYPE": 0,
    "GPS2_TYPE": 0,
    "COMPASS_ENABLE": 0,
    "COMPASS_USE": 0,
    "COMPASS_USE2": 0,
    "COMPASS_USE3": 0,
    "FS_THR_ENABLE": 0,  # no transmitter
    "DISARM_DELAY": 0,
}
ARDUPILOT_HALL: Parameters = {
    "FS_GCS_ENABLE": 5,  # the companion's heartbeat lost: land
    "FS_GCS_TIMEOUT": 2,  # seconds
    "MAV_GCS_SYSID": 1,  # whose heartbeat: the vehicle's own system, which the companion is of
    "GUID_TIMEOUT": 1,  # seconds that the last setpoint is flown on, as PX4's COM_OF_LOSS_T
    "RTL_ALT": 500,  # centimetres
    "LAND_ALT_LOW": 300,  # centimetres, above which it comes down at 1.5 m/s: blind, each second is drift
}
ARDUPILOT_SIMULATION: Parameters = {
    "FRAME_CLASS": 1,
    "FRAME_TYPE": 1,  # X: the vehicle's motor order
    "SIM_GPS1_ENABLE": 0,
    # A downward rangefinder out of the physics protocol (rng_1).
    "RNGFND1_TYPE": 100,
    "RNGFND1_ORIENT": 25,
    "RNGFND1_MIN": 0.05,
    "RNGFND1_MAX": 40,
    "BATT_MONITOR": 4,
    # Transmitter and accelerometers that count as calibrated.
    **{f"RC{i}_{name}": value for i in range(1, 9) for name, value in (("MIN", 1000), ("TRIM", 1500), ("MAX", 2000))},
    **{f"INS_ACC{n}OFFS_{axis}": 0.001 for n in ("", "2") for axis in "XYZ"},
    **{f"INS_ACC{n}SCAL_{axis}": 1.001 for n in ("", "2") for axis in "XYZ"},
}  # fmt: skip

PX4: Parameters = PX4_VISION | PX4_HALL | PX4_SIMULATION
ARDUPILOT: Parameters = ARDUPILOT_VISION | ARDUPILOT_HALL | ARDUPILOT_SIMULATION
