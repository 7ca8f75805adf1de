"""A session put into the map of a store on disk: what `map update` does, and what it says."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from stereo_sfm.config import Config
from stereo_sfm.loop.vocabulary_file import configured_vocabulary
from stereo_sfm.maps.changes import changed_cells, describe_changes
from stereo_sfm.maps.saved_map import SavedMap, load_map
from stereo_sfm.maps.store import KEPT_VERSIONS, read_about, write_version
from stereo_sfm.maps.update import update


@dataclass(frozen=True)
class Put:
    """What became of a session."""

    text: str  # one line
    changes: list[str]  # of shelves; of the first session none


def put_session(
    store: Path, session: SavedMap, name: str, config: Config, keep: int = KEPT_VERSIONS, compress: bool = True
) -> Put:
    """Make a new version of a store, which the caller has locked, from it and a session's own map.

    Args:
        store, session. name: of the session, for messages. config: of the loop search and the bundle adjustment.
        keep: earlier versions. compress: as of `save_map`.

    Raises:
        StereoSfmError: no loop joins the session to the map, or it is in the map already.
    """
    if not (store / "map.json").exists():
        write_version(store, session, ["the first session"], keep, compress)
        return Put(f"begun with {name}, {len(session)} keyframes", [])
    saved = load_map(store, session.rig)
    result = update(saved, session, configured_vocabulary(config.loop), config.loop, config.mapper)
    about = read_about(store, saved)
    changes = describe_changes(changed_cells(result, about.map_T_floor), about.aisles)
    number = write_version(store, result.saved, changes, keep, compress)
    return Put(
        f"version {number}: {name}, {len(result.loops)} loops, {result.fused} points found again,"
        f" {len(saved)} + {len(session)} - {result.forgotten} -> {len(result.saved)} keyframes,"
        f" {len(result.saved.snapshot.pt_ids)} points",
        changes or ["no shelf changed"],
    )
