"""Scans and poses -> PointMap; export."""

from companion.mapping.mapper import Mapper

__all__ = ["Mapper"]
