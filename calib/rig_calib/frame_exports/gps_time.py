"""GPS time, as surveying formats date their points."""

_UNIX_TIME_OF_GPS_EPOCH_S = 315_964_800  # 6 January 1980
_LEAP_SECONDS = 18  # since 2017, and none is announced


def gps_seconds(utc_ns: int) -> float:
    """Seconds since the GPS epoch of a Unix time since 2017."""
    return utc_ns * 1e-9 - _UNIX_TIME_OF_GPS_EPOCH_S + _LEAP_SECONDS
