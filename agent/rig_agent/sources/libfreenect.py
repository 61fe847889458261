"""The part of libfreenect's C interface that this project uses, bound with ctypes.

Layouts and signatures: libfreenect.h and libfreenect_registration.h of libfreenect 0.5.
"""

import ctypes as c
from pathlib import Path
from typing import Any, NamedTuple

from rig_protocol.errors import ConfigurationError
from rig_protocol.troubleshooting import Topic

RESOLUTION_MEDIUM = 1
VIDEO_BAYER = 1
DEPTH_11BIT = 0
DEVICE_CAMERA = 2
LOG_ERROR, LOG_WARNING, LOG_SPEW = 1, 2, 6

_DEFAULT_NAMES = ("libfreenect.so.0.5", "libfreenect.so.0", "libfreenect.so")


class FrameMode(c.Structure):
    """`freenect_frame_mode`, passed by value."""

    _fields_ = (
        ("reserved", c.c_uint32),
        ("resolution", c.c_int32),
        ("format", c.c_int32),
        ("bytes", c.c_int32),
        ("width", c.c_int16),
        ("height", c.c_int16),
        ("data_bits", c.c_int8),
        ("padding_bits", c.c_int8),
        ("framerate", c.c_int8),
        ("is_valid", c.c_int8),
    )


class Timeval(c.Structure):
    """`struct timeval`."""

    _fields_ = (("seconds", c.c_long), ("microseconds", c.c_long))


class RegistrationStruct(c.Structure):
    """`freenect_registration`; the three tables are freed by `freenect_destroy_registration`."""

    _fields_ = (
        ("reg_info", c.c_int32 * 29),
        ("reg_pad_info", c.c_uint16 * 3),
        ("emitter_distance_cm", c.c_float),
        ("color_distance_cm", c.c_float),
        ("reference_distance_cm", c.c_float),
        ("reference_pixel_size_cm", c.c_float),
        ("const_shift", c.c_double),
        ("raw_to_mm_shift", c.c_void_p),
        ("depth_to_rgb_shift", c.c_void_p),
        ("registration_table", c.c_void_p),
    )


class ZeroPlane(NamedTuple):
    """The unit's factory data: what turns its disparity into depth."""

    emitter_distance_cm: float
    reference_distance_cm: float
    reference_pixel_size_cm: float
    const_shift: float


FRAME_CALLBACK = c.CFUNCTYPE(None, c.c_void_p, c.c_void_p, c.c_uint32)
LOG_CALLBACK = c.CFUNCTYPE(None, c.c_void_p, c.c_int, c.c_char_p)

_CONTEXT = _DEVICE = c.c_void_p
_SIGNATURES: dict[str, tuple[Any, list[Any]]] = {
    "freenect_init": (c.c_int, [c.POINTER(_CONTEXT), c.c_void_p]),
    "freenect_shutdown": (c.c_int, [_CONTEXT]),
    "freenect_set_log_level": (None, [_CONTEXT, c.c_int]),
    "freenect_set_log_callback": (None, [_CONTEXT, LOG_CALLBACK]),
    "freenect_select_subdevices": (None, [_CONTEXT, c.c_int]),
    "freenect_process_events_timeout": (c.c_int, [_CONTEXT, c.POINTER(Timeval)]),
    "freenect_open_device": (c.c_int, [_CONTEXT, c.POINTER(_DEVICE), c.c_int]),
    "freenect_close_device": (c.c_int, [_DEVICE]),
    "freenect_find_video_mode": (FrameMode, [c.c_int, c.c_int]),
    "freenect_find_depth_mode": (FrameMode, [c.c_int, c.c_int]),
    "freenect_set_video_mode": (c.c_int, [_DEVICE, FrameMode]),
    "freenect_set_depth_mode": (c.c_int, [_DEVICE, FrameMode]),
    "freenect_set_video_callback": (None, [_DEVICE, FRAME_CALLBACK]),
    "freenect_set_depth_callback": (None, [_DEVICE, FRAME_CALLBACK]),
    "freenect_set_depth_buffer": (c.c_int, [_DEVICE, c.c_void_p]),
    "freenect_start_video": (c.c_int, [_DEVICE]),
    "freenect_start_depth": (c.c_int, [_DEVICE]),
    "freenect_stop_video": (c.c_int, [_DEVICE]),
    "freenect_stop_depth": (c.c_int, [_DEVICE]),
}
# fakenect and old versions lack these; without them the factory data is unknown.
_OPTIONAL_SIGNATURES: dict[str, tuple[Any, list[Any]]] = {
    "freenect_copy_registration": (RegistrationStruct, [_DEVICE]),
    "freenect_destroy_registration": (c.c_int, [c.POINTER(RegistrationStruct)]),
}


def load_libfreenect(path: Path | None = None) -> c.CDLL:
    """libfreenect with typed functions; ConfigurationError when it is missing or another library."""
    library = _open(path)
    missing = [name for name in _SIGNATURES if not hasattr(library, name)]
    if missing:
        raise ConfigurationError(
            f"{library._name} is no usable libfreenect: it lacks {', '.join(missing)}", Topic.MISSING_LIBRARY
        )
    for name, (result, arguments) in (_SIGNATURES | _OPTIONAL_SIGNATURES).items():
        if hasattr(library, name):
            function = getattr(library, name)
            function.restype, function.argtypes = result, arguments
    return library


def zero_plane(library: c.CDLL, device: c.c_void_p) -> ZeroPlane | None:
    """The factory data of an open device; None when this libfreenect does not tell."""
    if not (
        hasattr(library, "freenect_copy_registration") and hasattr(library, "freenect_destroy_registration")
    ):
        return None
    copy = library.freenect_copy_registration(device)
    library.freenect_destroy_registration(c.byref(copy))
    return ZeroPlane(
        emitter_distance_cm=copy.emitter_distance_cm,
        reference_distance_cm=copy.reference_distance_cm,
        reference_pixel_size_cm=copy.reference_pixel_size_cm,
        const_shift=copy.const_shift,
    )


def _open(path: Path | None) -> c.CDLL:
    names = _DEFAULT_NAMES if path is None else (str(path),)
    reasons = []
    for name in names:
        try:
            return c.CDLL(name)
        except OSError as error:
            reasons.append(str(error))
    raise ConfigurationError(
        f"libfreenect cannot be loaded ({reasons[0]}): apt install libfreenect0.5, "
        "or give its path as `library` in [freenect]",
        Topic.MISSING_LIBRARY,
    )
