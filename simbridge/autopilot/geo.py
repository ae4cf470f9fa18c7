"""Local north and east to latitude and longitude and back: azimuthal equidistant on a sphere, as PX4 projects."""

from __future__ import annotations

import math
from dataclasses import dataclass

EARTH_RADIUS_M = 6371000.0  # CONSTANTS_RADIUS_OF_EARTH


@dataclass(frozen=True, slots=True)
class Origin:
    """Where local (0, 0, 0) lies."""

    lat_deg: float
    lon_deg: float
    alt_m: float

    def project(self, lat_deg: float, lon_deg: float) -> tuple[float, float]:
        """North and east, m, of a point."""
        lat, lon = math.radians(lat_deg), math.radians(lon_deg)
        lat0, lon0 = math.radians(self.lat_deg), math.radians(self.lon_deg)
        d_lon = lon - lon0
        cos_c = math.sin(lat0) * math.sin(lat) + math.cos(lat0) * math.cos(lat) * math.cos(d_lon)
        c = math.acos(min(max(cos_c, -1.0), 1.0))
        k = c / math.sin(c) if abs(c) > 1e-12 else 1.0
        north = k * (math.cos(lat0) * math.sin(lat) - math.sin(lat0) * math.cos(lat) * math.cos(d_lon))
        return north * EARTH_RADIUS_M, k * math.cos(lat) * math.sin(d_lon) * EARTH_RADIUS_M

    def reproject(self, north_m: float, east_m: float) -> tuple[float, float]:
        """Latitude and longitude, degrees, of a local point."""
        x, y = north_m / EARTH_RADIUS_M, east_m / EARTH_RADIUS_M
        c = math.hypot(x, y)
        if c < 1e-12:
            return self.lat_deg, self.lon_deg
        lat0, lon0 = math.radians(self.lat_deg), math.radians(self.lon_deg)
        sin_c, cos_c = math.sin(c), math.cos(c)
        lat = math.asin(cos_c * math.sin(lat0) + x * sin_c * math.cos(lat0) / c)
        lon = lon0 + math.atan2(y * sin_c, c * math.cos(lat0) * cos_c - x * math.sin(lat0) * sin_c)
        return math.degrees(lat), math.degrees(lon)
