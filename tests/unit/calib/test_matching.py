"""Features, overlap regions and matches."""

from dataclasses import replace

import cv2
import numpy as np

from rig_calib.features import Keypoints, detect, detect_coarsely, mean_grey
from rig_calib.matching import flann_matches, mutual_matches
from rig_calib.overlap import Region, joined, shared_regions, whole_image
from rig_protocol.camera import Intrinsics
from rig_protocol.rig_folder import RingDrawing

CAMERA = Intrinsics(525.0, 525.0, 319.5, 239.5)
SIGMA_PX = 0.25
WHOLE = (Region(0, 0, 640, 480), Region(0, 0, 640, 480))


def keypoints(descriptors: np.ndarray, place: list[int] | None = None) -> Keypoints:
    count = len(descriptors)
    pixels = np.column_stack([np.arange(count) * 10.0, np.full(count, 100.0)])
    information = np.broadcast_to(np.eye(2), (count, 2, 2))
    return Keypoints(pixels, information, descriptors.astype(np.float32), np.array(place or range(count)))


def random_descriptors(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0, 60, (count, 128))


def noise_image(seed: int = 0) -> np.ndarray:
    small = np.random.default_rng(seed).integers(0, 256, (60, 80), dtype=np.uint8)
    return cv2.resize(small, (640, 480), interpolation=cv2.INTER_CUBIC)


def test_only_neighbours_of_the_ring_share_a_view() -> None:
    nominal = {c: RingDrawing().T_rig_camera(c) for c in range(12)}
    regions = shared_regions(dict.fromkeys(range(12), CAMERA), nominal, 7.0)
    assert sorted(regions) == sorted([(c, c + 1) for c in range(11)] + [(0, 11)])


def test_a_vertical_camera_shares_the_rows_on_its_neighbours_side() -> None:
    """Image +y points to the next camera, so that the overlap with it lies at high rows."""
    nominal = {c: RingDrawing().T_rig_camera(c) for c in range(2)}
    of_first, of_second = shared_regions({0: CAMERA, 1: CAMERA}, nominal, 0.0)[0, 1]
    assert of_first.bottom == 480
    assert 240 < of_first.top < 400
    assert of_second.top == 0
    assert (of_first.left, of_first.right) == (0, 640)


def test_without_a_drawing_every_pair_may_share_everything() -> None:
    regions = shared_regions(dict.fromkeys(range(4), CAMERA), dict.fromkeys(range(4)), 7.0)
    assert len(regions) == 6
    assert regions[0, 3] == (whole_image(CAMERA), whole_image(CAMERA))


def test_keypoints_keep_to_the_region_and_do_not_depend_on_the_crop() -> None:
    image = noise_image()
    region = Region(200, 100, 400, 300)
    found = detect(image, region, 3000, SIGMA_PX)
    everywhere = detect(image, Region(0, 0, 640, 480), 20000, SIGMA_PX)
    assert len(found) > 20
    assert region.contains(found.pixels).all()
    distance = np.linalg.norm(found.pixels[:, None] - everywhere.pixels[None], axis=2).min(axis=1)
    assert np.mean(distance < 0.1) > 0.7


def test_keypoint_positions_are_not_shifted() -> None:
    """A blob drawn at a known sub-pixel place is found there."""
    v, u = np.mgrid[:200, :200]
    image = (40 + 180 * np.exp(-((u - 100.3) ** 2 + (v - 80.7) ** 2) / (2 * 4.0**2))).astype(np.uint8)
    found = detect(image, Region(0, 0, 200, 200), 100, SIGMA_PX)
    nearest = found.pixels[np.linalg.norm(found.pixels - (100.3, 80.7), axis=1).argmin()]
    np.testing.assert_allclose(nearest, (100.3, 80.7), atol=0.1)


def test_keypoints_of_half_the_image_lie_where_the_whole_one_has_them() -> None:
    """A blob is found without a shift, and information by the whole pixel."""
    v, u = np.mgrid[:200, :200]
    image = (40 + 180 * np.exp(-((u - 100.3) ** 2 + (v - 80.7) ** 2) / (2 * 6.0**2))).astype(np.uint8)
    found = detect_coarsely(image, [Region(0, 0, 200, 200)], 100, SIGMA_PX)
    nearest = np.linalg.norm(found.pixels - (100.3, 80.7), axis=1).argmin()
    np.testing.assert_allclose(found.pixels[nearest], (100.3, 80.7), atol=0.1)
    assert np.sqrt(1 / found.information[nearest, 0, 0]) >= 2 * SIGMA_PX


def test_keypoints_for_a_start_are_spread_where_one_corner_has_most_of_the_texture() -> None:
    image = noise_image()
    image[240:] = cv2.GaussianBlur(image, (0, 0), 3.0)[240:]  # larger blobs, and fewer
    regions = [Region(0, 0, 640, 200), Region(0, 280, 640, 480)]
    found = detect_coarsely(image, regions, 3000, SIGMA_PX)
    counts = [region.contains(found.pixels).sum() for region in regions]
    assert min(counts) > 0.4 * sum(counts)
    assert len(np.unique(found.place)) == len(np.unique(found.pixels.round(3), axis=0))


def test_regions_that_meet_become_one() -> None:
    left, right, apart = Region(0, 0, 100, 100), Region(90, 20, 200, 120), Region(300, 0, 400, 50)
    assert joined([left, apart, right]) == [apart, Region(0, 0, 200, 120)]
    assert joined([left, apart]) == [left, apart]


def test_tiles_cover_a_region_once() -> None:
    tiles = Region(10, 20, 330, 140).tiles(160)
    assert len(tiles) == 2
    v, u = np.mgrid[20:140, 10:330]
    inside = sum(tile.contains(np.column_stack([u.ravel(), v.ravel()]) + 0.25) for tile in tiles)
    assert (np.asarray(inside) == 1).all()


def test_large_keypoints_are_placed_less_well() -> None:
    v, u = np.mgrid[:400, :400]
    image = np.full((400, 400), 60.0)
    for at, size_px in ((60, 1.2), (240, 22.0)):
        image += 150 * np.exp(-((u - at) ** 2 + (v - at) ** 2) / (2 * size_px**2))
    found = detect(image.astype(np.uint8), Region(0, 0, 400, 400), 100, SIGMA_PX)
    small, large = (np.linalg.norm(found.pixels - at, axis=1).argmin() for at in (60, 240))
    sigma_px = np.sqrt(1 / found.information[:, 0, 0])
    assert SIGMA_PX < sigma_px[small] < 0.3
    assert sigma_px[large] > 0.9


def test_an_image_without_texture_has_no_keypoints() -> None:
    found = detect(np.full((480, 640), 128, np.uint8), Region(0, 0, 640, 480), 100, SIGMA_PX)
    assert len(found) == 0
    assert found.information.shape == (0, 2, 2)


def test_frames_are_averaged_in_grey() -> None:
    grey = np.full((4, 4), 100, np.uint8)
    bgr = np.full((4, 4, 3), 110, np.uint8)
    assert mean_grey([grey, bgr]).tolist() == [[105] * 4] * 4


def test_matches_are_nearest_both_ways() -> None:
    descriptors = random_descriptors(30)
    order = np.random.default_rng(1).permutation(30)
    matches = mutual_matches(keypoints(descriptors), keypoints(descriptors[order]), WHOLE, 0.85, 250.0)
    assert len(matches) == 30
    assert (order[matches[:, 1]] == matches[:, 0]).all()


def test_a_place_that_looks_like_two_others_has_no_match() -> None:
    descriptors = random_descriptors(5)
    twice = np.vstack([descriptors, descriptors[:1] + 0.5])
    matches = mutual_matches(keypoints(descriptors + 0.25), keypoints(twice), WHOLE, 0.85, 250.0)
    assert 0 not in matches[:, 0]


def test_a_second_description_of_the_same_place_is_no_rival() -> None:
    descriptors = random_descriptors(5)
    twice = np.vstack([descriptors, descriptors[:1] + 0.5])
    same = replace(keypoints(twice), place=np.array([0, 1, 2, 3, 4, 0]))
    matches = mutual_matches(keypoints(descriptors + 0.25), same, WHOLE, 0.85, 250.0)
    assert 0 in matches[:, 0]


def test_keypoints_outside_the_shared_region_do_not_match() -> None:
    descriptors = random_descriptors(30)
    left = (Region(0, 0, 105, 480), Region(0, 0, 640, 480))
    matches = mutual_matches(keypoints(descriptors), keypoints(descriptors), left, 0.85, 250.0)
    assert sorted(matches[:, 0]) == list(range(11))


def test_flann_matches_keep_a_multiple_of_the_smallest_distance() -> None:
    descriptors = random_descriptors(20)
    moved = descriptors.copy()
    moved[:10, 0] += 2.0
    moved[10:, 0] += 9.0
    matches = flann_matches(keypoints(descriptors), keypoints(moved), WHOLE, 3.0, seed=0)
    assert sorted(matches[:, 0]) == list(range(10))


def test_flann_matches_are_the_same_in_every_run() -> None:
    a, b = keypoints(random_descriptors(300)), keypoints(random_descriptors(300, seed=1))
    first, second = (flann_matches(a, b, WHOLE, 10.0, seed=3) for _ in range(2))
    assert first.tolist() == second.tolist()
