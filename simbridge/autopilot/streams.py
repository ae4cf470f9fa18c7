"""What the emulated PX4 says of itself: one packer per message, and how often each leaves on each kind of link.

Values are in wire order (largest types first). Rates: the recorded first seconds (mode Onboard) and PX4's mode Normal.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from simbridge.autopilot import control_kernels as k
from simbridge.autopilot.controller import Takeoff
from simbridge.autopilot.modes import Mode
from simbridge.autopilot.wire import BY_NAME

if TYPE_CHECKING:
    from simbridge.autopilot.autopilot import Autopilot

NAN = math.nan
Values = list[Any] | tuple[Any, ...]

ONBOARD_HZ: dict[str, float] = {
    "ALTITUDE": 10, "ATTITUDE": 50, "ATTITUDE_QUATERNION": 50, "ATTITUDE_TARGET": 10, "BATTERY_STATUS": 0.5,
    "CURRENT_MODE": 0.5, "DISTANCE_SENSOR": 10, "ESTIMATOR_STATUS": 1, "EXTENDED_SYS_STATE": 5, "GLOBAL_POSITION_INT": 10,
    "HEARTBEAT": 1, "HIGHRES_IMU": 50, "HOME_POSITION": 0.5, "LOCAL_POSITION_NED": 30, "MISSION_CURRENT": 1,
    "ODOMETRY": 30, "PING": 1, "POSITION_TARGET_LOCAL_NED": 10, "SCALED_PRESSURE": 1, "SERVO_OUTPUT_RAW": 10,
    "SYSTEM_TIME": 1, "SYS_STATUS": 5, "TIMESYNC": 10, "VFR_HUD": 10, "VIBRATION": 0.5,
}  # fmt: skip
NORMAL_HZ: dict[str, float] = {
    "ALTITUDE": 1, "ATTITUDE": 15, "ATTITUDE_TARGET": 2, "BATTERY_STATUS": 0.5, "CURRENT_MODE": 0.5,
    "DISTANCE_SENSOR": 0.5, "ESTIMATOR_STATUS": 0.5, "EXTENDED_SYS_STATE": 1, "GLOBAL_POSITION_INT": 5, "HEARTBEAT": 1,
    "HOME_POSITION": 0.5, "LOCAL_POSITION_NED": 1, "MISSION_CURRENT": 1, "PING": 0.1, "POSITION_TARGET_LOCAL_NED": 1.5,
    "SCALED_PRESSURE": 1, "SERVO_OUTPUT_RAW": 1, "SYSTEM_TIME": 1, "SYS_STATUS": 1, "VFR_HUD": 4, "VIBRATION": 0.1,
}  # fmt: skip
# Known to PX4, accepted by SET_MESSAGE_INTERVAL, but this emulation has nothing to say in them.
SILENT_IDS = frozenset({8, 24, 62, 65, 87, 106, 132, 290, 291, 380, 397, 410, 411, 514, 12901, 12904, 231})

# onboard_control_sensors_*: recorded. 0x4000: horizontal position control, 0x10000000: ready to arm.
PRESENT, ENABLED, HEALTHY, POSITION_BIT, READY_BIT = 0x300C00F, 0x301C00F, 0x320883F, 0x4000, 0x10000000


def ms(a: Autopilot) -> int:
    return (a.boot_ns // 1_000_000) & 0xFFFFFFFF


def us(a: Autopilot) -> int:
    return a.boot_ns // 1000


def heartbeat(a: Autopilot) -> Values:
    c = a.commander
    return (c.mode.custom_mode, 2, 12, c.base_mode, c.system_status, 3)


def attitude(a: Autopilot) -> Values | None:
    if not a.ekf.attitude_valid:
        return None
    w, x, y, z = a.ekf.o[0:4].tolist()
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(min(max(2 * (w * y - z * x), -1.0), 1.0))
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return (ms(a), roll, pitch, yaw, *a.ekf.o[10:13].tolist())


def attitude_quaternion(a: Autopilot) -> Values | None:
    if not a.ekf.attitude_valid:
        return None
    q = a.ekf.o[0:4].tolist()
    if q[0] < 0:
        q = [-v for v in q]
    return (ms(a), *q, *a.ekf.o[10:13].tolist(), 0.0, 0.0, 0.0, 0.0)


def local_position(a: Autopilot) -> Values:
    o = a.ekf.o[4:10].tolist()
    return (ms(a), *o[3:6], *o[0:3])


def odometry(a: Autopilot) -> Values:
    ekf = a.ekf
    o, d = ekf.o.tolist(), ekf.P.diagonal().tolist()
    pose, twist = [0.0] * 21, [0.0] * 21
    for at, i in zip((0, 6, 11, 15, 18, 20), (6, 7, 8, 0, 1, 2), strict=True):
        pose[at] = d[i]
    for at, i in zip((0, 6, 11), (3, 4, 5), strict=True):
        twist[at] = d[i]
    resets = ekf.vision.reset_count & 0xFF
    return (us(a), *o[7:10], *o[0:4], *o[4:7], *o[10:13], *pose, *twist, 1, 1, resets, 8, 0)


def estimator_status(a: Autopilot) -> Values:
    v, ekf = a.ekf.vision, a.ekf
    root = math.sqrt
    height = v.height.ratio if v.height.active else ekf.baro_ratio
    heading = v.heading.ratio
    return (
        us(a),
        root(v.velocity.ratio) if v.velocity.active else NAN,
        root(v.position.ratio) if v.position.active else NAN,
        root(height) if height >= 0 else NAN,
        root(heading) if heading >= 0 else NAN,
        NAN,
        NAN,
        ekf.eph_m,
        ekf.epv_m,
        ekf.flags(),
    )


def extended_sys_state(a: Autopilot) -> Values:
    return (0, a.landed_state)


def sys_status(a: Autopilot) -> Values:
    c, b = a.commander, a.battery
    health = HEALTHY | (POSITION_BIT if a.ekf.xy_valid else 0) | (READY_BIT if not c.is_armed and c.can_arm() else 0)
    if c.is_armed and not c.in_failsafe:
        health |= READY_BIT
    percent = math.ceil(b.remaining * 100) if b.connected else -1
    millivolt = round(b.voltage_v * 1000) if b.connected else 0xFFFF
    return (PRESENT, ENABLED, health, 140, millivolt, -1, 0, 0, 0, 0, 0, 0, percent, 0, 0, 0)


def battery_status(a: Autopilot) -> Values | None:
    b = a.battery
    if not b.connected:
        return None
    percent = math.ceil(b.remaining * 100)
    cells = [round(b.voltage_v * 1000)] + [0xFFFF] * 9
    charge = {0: 1, 1: 2, 2: 3, 3: 4}[b.warning]
    return (0, -1, 0x7FFF, *cells, -1, 0, 1, 1, percent, 0, charge, 0, 0, 0, 0, 0, 0)


def current_mode(a: Autopilot) -> Values:
    c = a.commander
    return (c.mode.custom_mode, c.intended.custom_mode, c.mode.value.standard)


def highres_imu(a: Autopilot) -> Values | None:
    if a.imu is None:
        return None
    f, w = a.imu.accel_frd_mps2.tolist(), a.imu.gyro_frd_radps.tolist()
    pressure, altitude, temperature = (
        (a.baro.pressure_hpa, a.baro.pressure_altitude_m, a.baro.temperature_c) if a.baro else (NAN, NAN, NAN)
    )
    return (us(a), *f, *w, 0.0, 0.0, 0.0, pressure, 0.0, altitude, temperature, 0x1A3F, 0)


def scaled_pressure(a: Autopilot) -> Values | None:
    if a.baro is None:
        return None
    return (ms(a), a.baro.pressure_hpa, 0.0, round(a.baro.temperature_c * 100), 0)


def distance_sensor(a: Autopilot) -> Values | None:
    if a.distance_bottom_m is None:
        return None
    centimetres = min(max(round(a.distance_bottom_m * 100), 0), 65535)
    return (ms(a), 10, 5000, centimetres, 0, 0, 25, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 100)


def position_target(a: Autopilot) -> Values:
    sp, m = a.controller.setpoint.tolist(), a.controller.memory
    if not a.commander.is_armed or (a.land.maybe_landed and a.takeoff.state < Takeoff.RAMP):
        return (ms(a), *[NAN] * 9, NAN, 0.0, 63, 1)
    mask = 0
    if a.commander.mode is not Mode.LAND:
        for i in range(6):
            mask |= (1 << i) if math.isnan(sp[i]) else 0
    velocity = m[k.VEL_SP : k.VEL_SP + 3].tolist()
    acceleration = m[k.ACC_SP : k.ACC_SP + 3].tolist()
    return (ms(a), *sp[0:3], *velocity, *acceleration, sp[9], sp[10] if sp[10] == sp[10] else 0.0, mask, 1)


def attitude_target(a: Autopilot) -> Values:
    m = a.controller.memory
    q, rates = m[k.Q_SP : k.Q_SP + 4].tolist(), m[k.RATE_SP : k.RATE_SP + 3].tolist()
    return (ms(a), *q, *rates, a.controller.thrust, 0, 0, 0, 0, 0.0, 0.0, 0.0)[: _COUNT["ATTITUDE_TARGET"]]


def servo_output(a: Autopilot) -> Values:
    pwm = [round(1000 + 1000 * u) if a.commander.is_armed else 900 for u in a.controller.motors.tolist()]
    return (us(a) & 0xFFFFFFFF, *pwm, *[900] * 4, 0, *[900] * 8)


def vfr_hud(a: Autopilot) -> Values:
    o = a.ekf.o
    heading = int(math.degrees(a.ekf.yaw_rad) % 360)
    return (NAN, math.hypot(o[4], o[5]), -float(o[9]), -float(o[6]), heading, round(a.controller.thrust * 100))


def altitude(a: Autopilot) -> Values:
    up = -float(a.ekf.o[9])
    bottom = a.distance_bottom_m if a.distance_bottom_m is not None else NAN
    amsl = up + (a.ekf.origin.alt_m if a.ekf.origin else 0.0)
    mono = a.baro.pressure_altitude_m if a.baro else NAN
    return (us(a), mono, amsl, up, up + float(a.tasks.home[2]), NAN, bottom)


def system_time(a: Autopilot) -> Values:
    return (a.unix_us + us(a), ms(a))


def ping(a: Autopilot) -> Values:
    return (us(a), (a.boot_ns // 1_000_000_000) & 0xFFFF, 0, 0)


def vibration(a: Autopilot) -> Values:
    return (us(a), 0.0, 0.0, 0.0, 0, 0, 0)


def mission_current(a: Autopilot) -> Values:
    total = len(a.missions.items)
    return (0, total if total else 65535, 1 if not total else 2, 2, 0, 0, 0)[: _COUNT["MISSION_CURRENT"]]


def global_position(a: Autopilot) -> Values | None:
    origin = a.ekf.origin
    if not a.ekf.global_valid or origin is None:
        return None
    o = a.ekf.o.tolist()
    lat, lon = origin.reproject(o[7], o[8])
    up = origin.alt_m - o[9]
    velocity = [max(min(round(v * 100), 32767), -32767) for v in o[4:7]]
    heading = round(math.degrees(a.ekf.yaw_rad) % 360 * 100)
    relative = round((-o[9] + float(a.tasks.home[2])) * 1000)
    return (ms(a), round(lat * 1e7), round(lon * 1e7), round(up * 1000), relative, *velocity, heading)


def home_position(a: Autopilot) -> Values | None:
    origin = a.ekf.origin
    if origin is None or not a.home_set:
        return None
    h = a.tasks.home.tolist()
    lat, lon = origin.reproject(h[0], h[1])
    up = round((origin.alt_m - h[2]) * 1000)
    return (round(lat * 1e7), round(lon * 1e7), up, *h, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, a.home_us)


def gps_global_origin(a: Autopilot) -> Values | None:
    origin = a.ekf.origin
    if origin is None:
        return None
    return (round(origin.lat_deg * 1e7), round(origin.lon_deg * 1e7), round(origin.alt_m * 1000), us(a))


def timesync(a: Autopilot) -> Values:
    return (0, a.boot_ns)


def autopilot_version(a: Autopilot) -> Values:
    version = 1 << 24 | 18 << 16 | 0xC0  # 1.18.0 release candidate, as recorded
    custom = list(b"emulated")
    return (59647, 0x53494D4252494447, version, version, 0, 1, 0, 0, *custom, *custom, *[0] * 8, *[0] * 18)


PACKERS: dict[str, Callable[[Any], Values | None]] = {
    "ALTITUDE": altitude,
    "ATTITUDE": attitude,
    "ATTITUDE_QUATERNION": attitude_quaternion,
    "ATTITUDE_TARGET": attitude_target,
    "AUTOPILOT_VERSION": autopilot_version,
    "BATTERY_STATUS": battery_status,
    "CURRENT_MODE": current_mode,
    "DISTANCE_SENSOR": distance_sensor,
    "ESTIMATOR_STATUS": estimator_status,
    "EXTENDED_SYS_STATE": extended_sys_state,
    "GLOBAL_POSITION_INT": global_position,
    "GPS_GLOBAL_ORIGIN": gps_global_origin,
    "HEARTBEAT": heartbeat,
    "HIGHRES_IMU": highres_imu,
    "HOME_POSITION": home_position,
    "LOCAL_POSITION_NED": local_position,
    "MISSION_CURRENT": mission_current,
    "ODOMETRY": odometry,
    "PING": ping,
    "POSITION_TARGET_LOCAL_NED": position_target,
    "SCALED_PRESSURE": scaled_pressure,
    "SERVO_OUTPUT_RAW": servo_output,
    "SYSTEM_TIME": system_time,
    "SYS_STATUS": sys_status,
    "TIMESYNC": timesync,
    "VFR_HUD": vfr_hud,
    "VIBRATION": vibration,
}
_COUNT = {name: sum(max(n, 1) for _, n in BY_NAME[name].slots.values()) for name in PACKERS}
