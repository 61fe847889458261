"""Rules of the reference scene: every seed is another room with the same properties."""

import numpy as np
import pytest

from rig_agent.simulator.ring import VirtualRig
from rig_agent.simulator.scene import Scene, build_scene
from rig_agent.simulator.settings import SimulatorSettings
from rig_protocol.camera import DEFAULT_COLOR
from rig_protocol.poses import inverse, transform_points

FURNITURE = {"wood", "books", "carton", "fabric"}
SEEDS = range(12)


def room(seed: int, **options: object) -> Scene:
    return build_scene(SimulatorSettings(seed=seed, **options))  # type: ignore[arg-type]  # tests choose fields


def wall_coverage(scene: Scene) -> float:
    """Share of the wall area that patterns cover, counted on a grid of 4 cm."""
    covered = total = 0
    for wall in scene.walls:
        along, up = np.meshgrid(np.arange(0.02, wall.length_m, 0.04), np.arange(0.02, wall.height_m, 0.04))
        points = wall.origin + along[..., None] * wall.right + up[..., None] * np.array([0, 0, 1.0])
        hidden = np.zeros(along.shape, bool)
        for surface in scene.surfaces:
            if surface.material == "pattern" and surface.normal @ wall.normal > 0.99:
                s, t = (
                    (points - surface.corner) @ edge / (edge @ edge)
                    for edge in (surface.edge_u, surface.edge_v)
                )
                near = abs((surface.corner - wall.origin) @ wall.normal) < 0.1
                hidden |= near & (s > 0) & (s < 1) & (t > 0) & (t < 1)
        covered, total = covered + int(hidden.sum()), total + hidden.size
    return covered / total


def first_material(scene: Scene, azimuth: float, elevation: float) -> str:
    """What a ray from the rig's axis meets first."""
    start = scene.T_room_rig[:3, 3]
    direction = np.array([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)])
    nearest, material = np.inf, "nothing"
    for surface in scene.surfaces:
        slope = direction @ surface.normal
        if slope >= -1e-9:
            continue
        reach = (surface.corner - start) @ surface.normal / slope
        offset = start + reach * direction - surface.corner
        s, t = (offset @ edge / (edge @ edge) for edge in (surface.edge_u, surface.edge_v))
        if 0 < reach < nearest and 0 <= s <= 1 and 0 <= t <= 1:
            nearest, material = float(reach), surface.material
    return material


def blocked_overlaps(scene: Scene) -> int:
    """Overlaps of the twelve whose middle, at the cameras' height, sees furniture."""
    yaw = np.arctan2(scene.T_room_rig[1, 0], scene.T_room_rig[0, 0])
    azimuths = yaw + np.deg2rad(30) * (np.arange(12) + 0.5)
    return sum(first_material(scene, azimuth, 0.0) in FURNITURE for azimuth in azimuths)


@pytest.mark.parametrize("seed", SEEDS)
def test_patterns_cover_at_most_sixty_per_cent_of_the_walls(seed: int) -> None:
    assert 0.3 < wall_coverage(room(seed)) <= 0.6


@pytest.mark.parametrize("seed", SEEDS)
def test_furniture_stands_in_front_of_two_overlaps(seed: int) -> None:
    assert blocked_overlaps(room(seed)) == 2


def test_no_overlap_is_blocked_when_none_is_asked_for() -> None:
    assert blocked_overlaps(room(3, blocked_overlaps=0)) == 0


def seen_by_both(settings: SimulatorSettings, i: int, j: int) -> int:
    """Pixels of camera i that show, beyond 0.75 m, what lies in the field of camera j too."""
    rig, camera = VirtualRig(settings), DEFAULT_COLOR
    z_m = rig.camera(i).view().color_z_m().astype(np.float64)
    v, u = np.indices(z_m.shape)
    points = np.stack([(u - camera.cx) / camera.fx * z_m, (v - camera.cy) / camera.fy * z_m, z_m], axis=-1)
    x, y, z = np.moveaxis(
        transform_points(inverse(rig.camera(j).T_rig_camera) @ rig.camera(i).T_rig_camera, points), -1, 0
    )
    inside = (z > 0) & (np.abs(x) < 0.58 * z) & (np.abs(y) < 0.43 * z)
    return int((inside & (z_m > 0.75)).sum())


def test_a_screened_overlap_leaves_its_cameras_nothing_in_common() -> None:
    settings = SimulatorSettings(seed=2, blocked_overlaps=0)
    assert seen_by_both(settings, 4, 5) > 20_000
    assert seen_by_both(settings.model_copy(update={"screened_overlap": 4}), 4, 5) == 0


@pytest.mark.parametrize("seed", SEEDS)
def test_furniture_stays_in_the_room_and_off_the_rig(seed: int) -> None:
    scene = room(seed)
    corners = np.concatenate([s.corners for s in scene.surfaces if s.material in FURNITURE])
    assert (np.abs(corners[:, :2]) <= (2.0, 2.5)).all()
    assert corners[:, 2].min() >= 0
    assert corners[:, 2].max() < 2.6
    assert np.hypot(*(corners - scene.T_room_rig[:3, 3])[:, :2].T).min() > 0.8


def test_the_room_is_closed_around_the_rig() -> None:
    scene = room(1)
    for azimuth in np.linspace(0, 2 * np.pi, 18):
        assert all(first_material(scene, azimuth, pitch) != "nothing" for pitch in (-1.2, -0.4, 0.3, 1.2))


def test_a_room_without_patterns_has_none() -> None:
    assert not any(surface.material == "pattern" for surface in room(0, patterns=False).surfaces)


def test_seeds_give_other_rooms_and_the_same_seed_the_same() -> None:
    def layout(seed: int) -> list[float]:
        return [float(surface.corner.sum()) for surface in room(seed).surfaces]

    assert layout(4) == layout(4)
    assert layout(4) != layout(5)


def test_textures_are_the_same_in_every_process_and_differ_between_panels() -> None:
    scene = room(2)
    panels = [i for i, surface in enumerate(scene.surfaces) if surface.material == "pattern"]
    first, again = (scene.surfaces[panels[0]].texture(scene.seed, panels[0], scene.light) for _ in range(2))
    other = scene.surfaces[panels[1]].texture(scene.seed, panels[1], scene.light)
    assert np.array_equal(first, again)
    assert not np.array_equal(first[:300, :300], other[:300, :300])


def test_patterns_have_detail_at_every_scale_and_walls_hardly_any() -> None:
    scene = room(2)
    contrast = {}
    for material in ("pattern", "paint"):
        index = next(i for i, surface in enumerate(scene.surfaces) if surface.material == material)
        grey = scene.surfaces[index].texture(scene.seed, index, scene.light).mean(axis=2)[20:340, 20:340]
        blocks = [grey.reshape(320 // b, b, 320 // b, b).mean(axis=(1, 3)) for b in (4, 16, 64)]
        contrast[material] = [float(np.diff(block, axis=1).std()) for block in blocks]
    assert min(contrast["pattern"]) > 10
    assert all(strong > 3 * weak for strong, weak in zip(*contrast.values(), strict=True))
