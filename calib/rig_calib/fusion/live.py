"""LiveFusion: one cloud and one RGB-D panorama a panoramic frame, at the cameras' rate."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from queue import SimpleQueue
from types import TracebackType
from typing import Self, TypeVar

import cv2
import numpy as np
import numpy.typing as npt

from rig_calib.fusion.cylinder import Cylinder
from rig_calib.fusion.gains import Gain
from rig_calib.fusion.live_arrays import (
    BAYER,
    BGR,
    EMPTY,
    GREY,
    MAX_WIDTH,
    NOTHING,
    PITCH,
    Drum,
    Lens,
    Ring,
    Scratch,
)
from rig_calib.fusion.live_cleaning import clean_depth
from rig_calib.fusion.live_panorama import blend_columns, close_ranks
from rig_calib.fusion.live_points import pack_colors, place_points
from rig_calib.fusion.panorama import DEFAULT_CIRCLE_PX
from rig_calib.fusion.ray_tables import PlacedGrid, circle_around, drum_around, ring_tables
from rig_calib.fusion.viewpoint import rig_viewpoint
from rig_calib.rig_calibration import RigCalibration
from rig_protocol.camera import CameraModel
from rig_protocol.errors import ConfigurationError, DataError
from rig_protocol.frames import DepthFrame, ImageU8, ImageU16, PanoramicFrame, RgbdFrame
from rig_protocol.poses import Pose, inverse

Array32 = npt.NDArray[np.float32]
Tool = TypeVar("Tool")

_BAND_COLUMNS = 128  # of the panorama, blended by one thread at a time
_CLOUD = -1  # the work beside the bands
_KIND = {2: GREY, 3: BGR}


@dataclass(frozen=True, slots=True)
class LiveFusionSettings:
    """`centre_m`: the point of the rig frame that the panorama is seen from, by default amid the cameras.

    `circle_px`: columns of a full circle. `threads`: the result is the same for any number. `depth_frame`:
    the camera whose pixels the depth images have. `gains`: factors on R, G, B by camera id, as `color_gains`
    finds them.
    """

    centre_m: tuple[float, float, float] | None = None
    circle_px: int = DEFAULT_CIRCLE_PX
    threads: int = 2
    depth_frame: DepthFrame = "depth"
    gains: Mapping[int, Gain] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """ConfigurationError for what makes no sense."""
        if not 16 <= self.circle_px <= 20_000:
            raise ConfigurationError(f"circle_px is {self.circle_px}, must be 16 to 20000")
        if not 1 <= self.threads <= 64:
            raise ConfigurationError(f"threads is {self.threads}, must be 1 to 64")
        if self.centre_m is not None and not np.isfinite(self.centre_m).all():
            raise ConfigurationError(f"centre_m is {self.centre_m}, must be three numbers, metres")


@dataclass(frozen=True, slots=True, eq=False)
class FusedFrame:
    """One panoramic frame, fused. The arrays are views of LiveFusion's own: copy what outlives the next.

    `points_m` (N,3) f32 in the rig frame and `colors` (N,3) u8, RGB: camera `camera_ids[k]` owns the rows
    `starts[k]` to `starts[k + 1]`. `panorama` (H,W,3) u8, BGR, black where nothing was measured, and
    `panorama_depth_m` (H,W) f32, the distance from the cylinder's axis, NaN there. `skipped` says in a
    sentence each which cameras gave nothing, and why.
    """

    index: int
    timestamp_ns: int
    points_m: Array32
    colors: ImageU8
    camera_ids: tuple[int, ...]
    starts: npt.NDArray[np.int64]
    panorama: ImageU8
    panorama_depth_m: Array32
    skipped: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Images:
    """What one camera delivered, as the kernels take it."""

    depth: ImageU16
    in_mm: bool
    color: ImageU8
    kind: int
    size: tuple[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class _Strip:
    """A band of the panorama, column by column; (columns,H) but for `turned`.

    Column by column into the panorama itself, every pixel would cost a cache line.
    """

    colors: npt.NDArray[np.uint32]
    depths: Array32
    turned: npt.NDArray[np.uint32]  # (H,columns)

    @classmethod
    def of_height(cls, height: int) -> "_Strip":
        shape = _BAND_COLUMNS, height
        turned = np.zeros(shape[::-1], np.uint32)
        return cls(np.zeros(shape, np.uint32), np.zeros(shape, np.float32), turned)

    def write(self, color: ImageU8, depth: Array32) -> None:
        """Into the band's colour (H,columns,3), BGR, and depth."""
        height, columns = depth.shape
        cv2.transpose(self.depths[:columns], depth)
        turned = self.turned[:, :columns]
        cv2.transpose(self.colors[:columns].view(np.int32), turned.view(np.int32))
        cv2.cvtColor(turned.view(np.uint8).reshape(height, columns, 4), cv2.COLOR_BGRA2BGR, color)


class LiveFusion:
    """Fuses panoramic frames of one calibrated rig. `with LiveFusion(...) as fusion: fusion.fuse(frame)`.

    Every array is made here, some 20 MB a Kinect; `fuse` makes none. Not for two callers at once.
    """

    def __init__(
        self,
        calibration: RigCalibration,
        models: Mapping[int, CameraModel],
        settings: LiveFusionSettings | None = None,
    ) -> None:
        """Tables for every camera that has a pose and a model of its depth camera; others are skipped.

        DataError when none has, or when depth images differ in size; ConfigurationError for a panorama of
        too many rows.
        """
        self.settings = settings or LiveFusionSettings()
        placed = {camera_id: T for camera_id, T in calibration.poses.items() if camera_id in models}
        if not placed:
            raise DataError("no camera has both a pose in the calibration and a model: nothing can be fused")
        by_id, self._left_out = self._usable_grids(calibration, models, placed)
        self.camera_ids = tuple(by_id)
        grids = list(by_id.values())
        if len({grid.shape for grid in grids}) > 1:
            raise DataError("live fusion takes cameras whose depth images are all of one size")
        if grids[0].shape[1] > MAX_WIDTH:
            raise DataError(f"live fusion takes depth images of at most {MAX_WIDTH} columns")
        self._grids = grids
        view = rig_viewpoint(placed, calibration.rig_frame).T_rig_view.copy()
        if self.settings.centre_m is not None:
            view[:3, 3] = self.settings.centre_m
        self.T_rig_view: Pose = view
        circle_px = self.settings.circle_px
        self.cylinder: Cylinder = circle_around(grids, inverse(view), circle_px)
        if self.cylinder.height > MAX_WIDTH:
            raise ConfigurationError(
                f"circle_px {circle_px} makes a panorama of {self.cylinder.height} rows: "
                f"take at most {circle_px * MAX_WIDTH // self.cylinder.height}"
            )
        self._ring: Ring = ring_tables(grids)
        self._drum: Drum = drum_around(grids, inverse(view), self.cylinder, circle_px)
        self._lenses: list[Lens] = [grid.lens() for grid in grids]
        self._gains = [
            np.asarray(self.settings.gains.get(i, (1.0, 1.0, 1.0)), np.float32) for i in self.camera_ids
        ]
        self._interrupted = False
        self._make_buffers(grids[0].shape)
        self._pool = ThreadPoolExecutor(self.settings.threads, "fusion")

    def __enter__(self) -> Self:
        """Itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close."""
        self.close()

    def close(self) -> None:
        """End the threads; harmless when already ended."""
        self._pool.shutdown()

    def fuse(self, panorama: PanoramicFrame) -> FusedFrame:
        """Cloud and panorama of one frame, valid until the next call; a camera that fails is in `skipped`."""
        images: list[_Images | None] = []
        skipped = list(self._left_out)
        for k, camera_id in enumerate(self.camera_ids):
            found = self._images(k, panorama.frames.get(camera_id))
            images.append(None if isinstance(found, str) else found)
            if isinstance(found, str):
                skipped.append(f"camera {camera_id}: left out, {found}")
        if self._interrupted:  # what was drawn then was never blended
            self._drum.cells[:] = EMPTY
        self._interrupted = True
        cameras = range(len(self.camera_ids))
        self._in_threads(lambda k: self._clean(k, images[k]), cameras)
        self._in_threads(lambda k: self._place(k, images[k]), cameras)
        self._in_threads(lambda first: self._finish(first), [_CLOUD, *self._bands])
        self._interrupted = False
        count = int(self._starts[-1])
        return FusedFrame(
            index=panorama.index,
            timestamp_ns=panorama.timestamp_ns,
            points_m=self._points[:count],
            colors=self._colors[:count],
            camera_ids=self.camera_ids,
            starts=self._starts,
            panorama=self._panorama,
            panorama_depth_m=self._panorama_depth,
            skipped=tuple(skipped),
        )

    @property
    def T_rig_depth(self) -> dict[int, Pose]:
        """Where every camera's depth image is seen from, by camera id."""
        return {i: grid.T_rig_grid for i, grid in zip(self.camera_ids, self._grids, strict=True)}

    def _usable_grids(
        self, calibration: RigCalibration, models: Mapping[int, CameraModel], placed: Iterable[int]
    ) -> tuple[dict[int, PlacedGrid], tuple[str, ...]]:
        """By camera id, and a sentence for every other; DataError when there are only others."""
        grids: dict[int, PlacedGrid] = {}
        left_out: list[str] = []
        for camera_id in sorted(placed):
            try:
                grids[camera_id] = self._grid(calibration, models, camera_id)
            except DataError as error:
                left_out.append(f"camera {camera_id}: left out, {error}")
        if not grids:
            raise DataError("; ".join(left_out))
        return grids, tuple(left_out)

    def _grid(
        self, calibration: RigCalibration, models: Mapping[int, CameraModel], camera_id: int
    ) -> PlacedGrid:
        camera = calibration.camera(camera_id)
        correction = None if camera is None else camera.depth_correction
        T_rig_camera = calibration.poses[camera_id]
        return PlacedGrid.of(models[camera_id], self.settings.depth_frame, T_rig_camera, correction)

    def _make_buffers(self, shape: tuple[int, int]) -> None:
        count, (height, width) = len(self.camera_ids), shape
        self._capacity = height * width
        self._measured = np.full((count, height, width), NOTHING)
        self._present = np.zeros(count, np.uint8)
        self._counts = np.zeros(count, np.int64)
        self._starts = np.zeros(count + 1, np.int64)
        self._points = np.zeros((count * self._capacity, 3), np.float32)
        self._colors = np.zeros((count * self._capacity, 3), np.uint8)
        size = self.cylinder.height, self.cylinder.width
        self._panorama = np.zeros((*size, 3), np.uint8)
        self._panorama_depth = np.full(size, np.nan, np.float32)
        self._bands = range(0, size[1], _BAND_COLUMNS)
        color_pixels = max(g.model.color.width * g.model.color.height for g in self._grids)
        self._scratches: SimpleQueue[Scratch] = SimpleQueue()
        self._strips: SimpleQueue[_Strip] = SimpleQueue()
        for _ in range(self.settings.threads):
            self._scratches.put(_scratch(shape, color_pixels))
            self._strips.put(_Strip.of_height(size[0]))

    def _in_threads(self, work: Callable[[int], None], items: Iterable[int]) -> None:
        for _ in self._pool.map(work, items):
            pass

    def _images(self, k: int, frame: RgbdFrame | None) -> "_Images | str":
        """What the kernels take of a frame, or why it cannot be taken."""
        if frame is None or frame.damaged:
            return "it delivered nothing" if frame is None else "its images are damaged"
        depth = frame.raw if frame.raw is not None else frame.depth_mm
        color = frame.bayer if frame.bayer is not None else frame.color
        if depth is None or color is None:
            return "it delivered no colour with depth"
        if frame.depth_frame != self.settings.depth_frame:
            return f"its depth is in the {frame.depth_frame} camera, not as the settings have it"
        camera = self._grids[k].model.color
        if depth.shape != self._grids[k].shape or color.shape[:2] != (camera.height, camera.width):
            return "its images are not of the size that its model states"
        kind = BAYER if frame.bayer is not None else _KIND[color.ndim]
        flat = np.ascontiguousarray(color).reshape(color.shape[0], -1)
        size = color.shape[0], color.shape[1]
        return _Images(np.ascontiguousarray(depth), frame.raw is None, flat, kind, size)

    def _clean(self, k: int, images: "_Images | None") -> None:
        self._present[k] = images is not None
        if images is None:  # its partners look here, too
            self._measured[k] = NOTHING
            return
        measured = self._measured[k]
        with _taken_from(self._scratches) as scratch:
            clean_depth(images.depth, images.in_mm, self._lenses[k], self._ring.scales[k], scratch, measured)

    def _place(self, k: int, images: "_Images | None") -> None:
        if images is None:
            self._counts[k] = 0
            return
        own = slice(k * self._capacity, (k + 1) * self._capacity)
        with _taken_from(self._scratches) as scratch:
            pack_colors(images.color, images.kind, self._gains[k], scratch.quads)
            self._counts[k] = place_points(
                k,
                self._measured,
                self._ring,
                self._drum,
                images.size,
                images.kind,
                int(self._ring.scans[k]),
                scratch,
                self._points[own],
                self._colors[own],
            )

    def _finish(self, first: int) -> None:
        """The cloud, or a band of columns of the panorama."""
        if first == _CLOUD:
            np.cumsum(self._counts, out=self._starts[1:])
            close_ranks(self._points, self._colors, self._capacity, self._counts)
            return
        last = min(first + _BAND_COLUMNS, self.cylinder.width)
        with _taken_from(self._scratches) as scratch, _taken_from(self._strips) as strip:
            colors, depths = strip.colors[: last - first], strip.depths[: last - first]
            blend_columns(first, last, self._drum, self._present, scratch.rows, colors, depths)
            strip.write(self._panorama[:, first:last], self._panorama_depth[:, first:last])


@contextmanager
def _taken_from(tools: "SimpleQueue[Tool]") -> Iterator[Tool]:
    """One of them, which goes back whatever happens: the next frame waits for it."""
    tool = tools.get()
    try:
        yield tool
    finally:
        tools.put(tool)


def _scratch(shape: tuple[int, int], color_pixels: int) -> Scratch:
    return Scratch(
        inverse=np.zeros(shape, np.float32),
        likely=np.zeros(shape, np.float32),
        solid=np.zeros(shape, np.uint8),
        eroded=np.zeros(shape, np.uint8),
        columns=np.zeros(shape[1], np.int16),
        rows=np.zeros(16 * PITCH, np.float32),
        places=np.zeros(4 * PITCH, np.int32),
        quads=np.zeros(color_pixels, np.uint32),
    )
