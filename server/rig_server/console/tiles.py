"""Tiles: one set as small upright JPEG pictures, encoded once for everybody who looks."""

import logging
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import cv2

from rig_protocol.camera import RawDepthModel
from rig_protocol.frames import ImageU8, PanoramicFrame, RgbdFrame
from rig_server.console.camera_pictures import Mode, color_picture, depth_picture, jpeg
from rig_server.console.picture_guide import PictureGuide
from rig_server.console.upright import felt_turns, turned

logger = logging.getLogger(__name__)

_LONGEST_WAY_NS = 10_000_000_000


@dataclass(frozen=True, slots=True)
class Look:
    """What somebody looks at: every camera in this mode, and one of them in full size."""

    mode: Mode = Mode.COLOR
    enlarged: int | None = None


@dataclass(frozen=True, slots=True)
class Tile:
    """One camera's picture. `received_ns`: rig time at which its last datagram was here."""

    camera_id: int
    width: int
    height: int
    received_ns: int
    data: bytes


@dataclass(frozen=True, slots=True, eq=False)
class TileRound:
    """One set's tiles, by mode, camera and whether they are full size."""

    index: int
    tiles: Mapping[tuple[Mode, int, bool], Tile]

    def seen_by(self, look: Look) -> list[Tile]:
        """What belongs to a look, by ascending camera id; the enlarged camera comes in full size only."""
        ids = sorted({camera_id for mode, camera_id, _ in self.tiles if mode == look.mode})
        keys = ((look.mode, camera_id, camera_id == look.enlarged) for camera_id in ids)
        return [self.tiles[key] for key in keys if key in self.tiles]


def tile_round(
    panorama: PanoramicFrame, offered_ns: int, guide: PictureGuide, looks: Collection[Look]
) -> TileRound:
    """Every tile that any of the looks wants; a camera without frame, or without that image, has none.

    `offered_ns`: rig time at which the set was there.
    """
    tiles = {}
    for camera_id, frame in panorama.frames.items():
        if frame is None:
            continue
        for mode, full in {(look.mode, look.enlarged == camera_id) for look in looks}:
            image = _picture(frame, guide, mode, full)
            if image is None:
                continue
            received_ns = _received_ns(frame, offered_ns)
            height, width = image.shape[:2]
            tiles[mode, camera_id, full] = Tile(camera_id, width, height, received_ns, jpeg(image))
    return TileRound(panorama.index, tiles)


def camera_picture(frame: RgbdFrame, guide: PictureGuide, mode: Mode, full: bool) -> ImageU8 | None:
    """One camera's picture (H,W,3) BGR, up is up; None where it has nothing of the kind."""
    if mode is Mode.DEPTH:
        image = depth_picture(frame, guide.raw_models.get(frame.camera_id, RawDepthModel()), full)
    else:
        image = color_picture(frame, full)
    if image is None:
        return None
    if mode is Mode.OVERLAP and frame.camera_id in guide.tints:
        image = guide.tints[frame.camera_id].over(image)
    turns = guide.turns.get(frame.camera_id, 0) if frame.gravity is None else felt_turns(frame.gravity)
    return turned(image, turns)


def _picture(frame: RgbdFrame, guide: PictureGuide, mode: Mode, full: bool) -> ImageU8 | None:
    """None also for images that OpenCV refuses, as of one pixel: all other cameras are shown."""
    try:
        return camera_picture(frame, guide, mode, full)
    except cv2.error as error:
        logger.debug("camera %d has no picture: %s", frame.camera_id, error)
        return None


def _received_ns(frame: RgbdFrame, offered_ns: int) -> int:
    """Those of a folder crossed no network, those of a recording another day."""
    received_ns = frame.received_ns
    if received_ns is None or not 0 <= offered_ns - received_ns < _LONGEST_WAY_NS:
        return offered_ns
    return received_ns
