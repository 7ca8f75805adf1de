"""A session in a saved map: its keyframes stay where the saved map has them, whatever moves the session's own map."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from stereo_sfm.config import LoopConfig, MapperConfig
from stereo_sfm.geometry import se3
from stereo_sfm.mapping.mapper import Mapper
from stereo_sfm.maps.extension import Extension
from stereo_sfm.types import F64, I64, Keyframe, LoopResult, MapUpdate, no_ids
from tests.synthetic import pinhole_rig


def at(x: float, y: float = 0.0) -> F64:
    return se3.from_rotation_translation(np.eye(3), np.array([x, y, 0.0]))


def keyframe(kf_id: int, submap_id: int, odom_T_cam: F64) -> Keyframe:
    none = np.zeros((0, 2))
    return Keyframe(
        kf_id, kf_id, kf_id * 10**9, odom_T_cam, no_ids(), none, none, np.zeros((0, 3)), np.zeros((0, 32), np.uint8),
        submap_id=submap_id,
    )  # fmt: skip


@dataclass
class Found:
    map_T_cam: F64
    found: bool = True
    kf_id: int = 0
    inliers: int = 100
    information: F64 = field(default_factory=lambda: 1e6 * np.eye(6))
    pairs: I64 = field(default_factory=lambda: no_ids(0, 2))


class Places:
    """A localizer that recognises some keyframes."""

    def __init__(self, places: dict[int, F64]) -> None:
        self.places, self.asked, self.last = places, list[int](), None

    def step(self, keyframe: Keyframe) -> MapUpdate:
        self.asked.append(keyframe.kf_id)
        place: Any = self.places.get(keyframe.kf_id)
        self.last = None if place is None else Found(place)  # type: ignore[assignment]
        map_T_odom = np.eye(4) if place is None else place @ se3.inverse(keyframe.odom_T_cam)
        return MapUpdate(1, keyframe.kf_id, no_ids(), np.zeros((0, 4, 4)), map_T_odom=map_T_odom)

    def relocalize(self) -> None:
        self.asked.append(-1)


@pytest.fixture
def session(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Without images: keyframes are inserted, and loops closed."""

    def step(self: Any, keyframe: Keyframe, loop: LoopResult | None = None) -> MapUpdate:
        self._version += 1
        if loop is not None:
            self._close(loop)
        self.map.add_keyframe(keyframe, self._map_T_odom @ keyframe.odom_T_cam)
        return self._update(keyframe.kf_id)

    monkeypatch.setattr(Mapper, "step", step)

    def begin(places: dict[int, F64]) -> Any:
        return Extension(MapperConfig(), pinhole_rig(), None, LoopConfig(), Places(places))  # type: ignore[arg-type]

    return begin


def pose(update: MapUpdate, of: Keyframe) -> F64:
    return (update.map_T_odom @ of.odom_T_cam)[:3, 3]


def test_a_loop_of_the_session_does_not_move_what_the_saved_map_shows(session: Any) -> None:
    """The second submap begins two metres beside its place, and is recognised; then a loop joins it with the first."""
    extension = session({2: at(102)})
    for k in range(2):
        extension.step(keyframe(k, 0, at(k)))
    seen = [keyframe(k, 1, at(k, 2.0)) for k in (2, 3, 4)]
    assert pose(extension.step(seen[0]), seen[0]) == pytest.approx([102, 0, 0])
    assert pose(extension.step(seen[1]), seen[1]) == pytest.approx([103, 0, 0])
    loop = LoopResult(3, 1, at(2), 1e6 * np.eye(6), no_ids(0, 2), 100, 1.0, "")
    update = extension.step(seen[2], loop)
    assert pose(update, seen[2]) == pytest.approx([104, 0, 0], abs=1e-6)
    found = dict(zip(update.kf_ids.tolist(), update.map_T_kf[:, :3, 3], strict=True))
    assert sorted(found) == [0, 1, 2, 3, 4]
    for k in range(5):
        assert found[k] == pytest.approx([100 + k, 0, 0], abs=1e-6)


def test_a_new_submap_is_placed_and_joined_by_the_saved_map(session: Any) -> None:
    """Tracking begins again where it was expected, two metres beside the place that the saved map shows."""
    extension = session({0: at(100), 3: at(103)})
    for k in range(2):
        extension.step(keyframe(k, 0, at(k)))
    assert extension._localizer.asked == [0]  # then it is known
    seen = [keyframe(k, 1, at(k, 2.0)) for k in (2, 3, 4)]
    extension.step(seen[0])
    update = extension.step(seen[1])
    assert extension._localizer.asked == [0, 2, 3]
    assert pose(update, seen[1]) == pytest.approx([103, 0, 0], abs=1e-6)
    assert pose(extension.step(seen[2]), seen[2]) == pytest.approx([104, 0, 0], abs=1e-6)
    found = dict(zip(update.kf_ids.tolist(), update.map_T_kf[:, :3, 3], strict=True))
    for k in range(4):
        assert found[k] == pytest.approx([100 + k, 0, 0], abs=1e-6)
    own = extension.map.keyframes.map_T_kf[:, :3, 3]  # in the session's own map, too
    assert own[3] - own[0] == pytest.approx([3, 0, 0], abs=1e-6)


def test_a_place_that_the_session_contradicts_is_not_taken(session: Any) -> None:
    """The session's own loops have joined its submaps; then another aisle looks like the place."""
    extension = session({0: at(100), 9: at(140, 7.0)})
    for k in range(4):
        extension.step(keyframe(k, 0, at(k)))
    for k in range(4, 9):
        loop = LoopResult(k - 1, k - 3, at(2), 1e6 * np.eye(6), no_ids(0, 2), 100, 1.0, "") if k in (6, 8) else None
        extension.step(keyframe(k, 1, at(k)), loop)
    seen = keyframe(9, 1, at(9))
    update = extension.step(seen)
    assert extension._localizer.asked[-2:] == [9, -1]  # and the whole map is searched again
    assert pose(update, seen) == pytest.approx([109, 0, 0], abs=1e-3) and not len(update.refused_kf_ids)
    assert not len(extension.step(keyframe(10, 1, at(10))).refused_kf_ids)
