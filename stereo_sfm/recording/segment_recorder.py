"""Records a run into segments without ever blocking it: a disk that is slow or full costs images, not poses.

Two threads write the two files of a segment. Images wait in a short queue and are dropped when it is full, poses in a
long one. When the disk is full, images stop first (`min_free`); poses continue in what is left, then in a reserve,
then wait for room.
"""

from __future__ import annotations

import contextlib
import functools
import os
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.folder_lock import FolderLock
from stereo_sfm.log.image_log import ImageLog
from stereo_sfm.log.provenance import Opening, write_provenance
from stereo_sfm.log.run_log import RunLog
from stereo_sfm.log.writer import LogWriter
from stereo_sfm.recording.quota import Disk, Quota, forget_images, make_room, used_bytes
from stereo_sfm.recording.segment_writers import ImageWriter, PoseWriter, Thumbnail
from stereo_sfm.recording.segments import RECORDING, Segment, about, describe, new_recording
from stereo_sfm.types import LEFT_OUT, Dropped, Frame, Observations, StereoImage

EVERY_S = 2.0  # between two checks of the disk, besides those at the beginning of a segment
SLOW_S = 5.0  # after an image was dropped the disk counts as slow
RESERVE, RESERVE_BYTES = ".reserve", 32 << 20
THUMBNAIL_S = 2.0


@dataclass(frozen=True)
class Policy:
    """What is recorded, and how much is kept."""

    root: Path
    mode: str  # full | lean | black_box
    image_format: str  # one of `images.FORMATS`
    segment_s: float
    segment_bytes: float
    quota: Quota
    black_box_s: float
    mark_before_s: float
    mark_after_s: float
    upload: str = ""  # address of a folder in a bucket; "": recordings stay here
    upload_bytes_s: float = 0.0  # 0: no limit


@dataclass(frozen=True)
class RecorderState:
    """State of a recording."""

    recording: str  # its folder's name
    segment: str
    bytes: int  # of all recordings
    images_dropped: int
    problem: str  # "" or one line
    full: bool = False  # the problem is a full disk, or quota
    seconds: int = 0  # from the first to the newest image


class SegmentRecorder:
    """One recording, in a folder that no other recorder uses meanwhile. `image`, `put` and `mark` never block."""

    def __init__(
        self,
        policy: Policy,
        rig: Rig,
        config: Config,
        source: str,
        opening: Opening | None = None,
        disk: Callable[[Path], Disk] = Disk.of,
    ) -> None:
        """Args:
        policy: what is kept. rig, config, source, opening: of the run. disk: how full the disk is.

        Raises:
            OSError: the folder cannot be made.
            StereoSfmError: another service records there.
        """
        self._policy, self._disk = policy, disk
        policy.root.mkdir(parents=True, exist_ok=True)
        self._lock = FolderLock(policy.root, "another service records there, choose another recording.folder")
        self._about = (source, policy.mode, datetime.now())
        self.folder = new_recording(policy.root, *self._about)
        self._folder_gone = False
        self._number, self._began_ns = 0, -1
        self.segment: Segment | None = None
        self._segment_ns = self._newest_ns = 0
        self._history: deque[tuple[Segment, int]] = deque()  # what a mark may reach; with the stamp of its beginning
        self._marks: dict[str, int] = {}  # text -> stamp until which new segments are marked with it
        self._next_thumbnail_ns = 0
        self._missed: deque[StereoImage] = deque(maxlen=LEFT_OUT)  # images dropped since the last one kept
        self.images_dropped, self._dropped_s = 0, -SLOW_S
        self._used = used_bytes(policy.root)
        self._no_room, self._only_marked = "", ""
        self._over, self._due, self._checking = False, threading.Event(), threading.Lock()
        begin = functools.partial(_begin_images, rig, source, policy.image_format, opening)
        self._images = ImageWriter(policy.image_format, begin, self._check_now)
        self._poses = PoseWriter(
            functools.partial(_run_log, rig=rig, config=config, source=source, opening=opening), self._make_room_now
        )
        self._check_now()  # a recorder that was killed may have left more than the quota
        self._keeper = threading.Thread(target=self._keep_checking, name="disk check", daemon=True)
        self._keeper.start()

    # -- messages -----------------------------------------------------------------------------------------------

    def image(self, image: StereoImage) -> bool:
        """An image with its pixels; False if it was dropped."""
        self._next_segment_if_due(image.stamp_ns)
        if image.stamp_ns >= self._next_thumbnail_ns:
            self._next_thumbnail_ns = image.stamp_ns + int(THUMBNAIL_S * 1e9)
            self._poses.put(Thumbnail(image))
        if self._policy.mode == "lean":
            return True
        if self._no_room or not self._images.put(self._following_missed(image)):
            self._dropped_s = time.monotonic()
            self.omit(image, self._no_room or self._images.problem or "the disk is slow")
            return False
        self._missed.clear()
        return True

    def omit(self, image: StereoImage, why: str) -> None:
        """An image that is not recorded: the recording says why, and its samples come with the next one."""
        self._next_segment_if_due(image.stamp_ns)
        self.images_dropped += 1
        self._missed.append(image.without_pixels())
        self._poses.put(Dropped(image.frame_id, image.stamp_ns, "log", why))

    def put(self, message: object) -> None:
        """Any other message of the run."""
        if isinstance(message, Frame):
            message = replace(message, observations=Observations.empty())
        self._poses.put(message)

    def mark(self, text: str) -> None:
        """Keep the recording around this moment."""
        now_ns = self._newest_ns
        lasting = {other: until_ns for other, until_ns in self._marks.items() if until_ns >= now_ns}
        self._marks = {**lasting, text: now_ns + int(self._policy.mark_after_s * 1e9)}
        from_ns, ends_ns = now_ns - int(self._policy.mark_before_s * 1e9), now_ns + 1
        for segment, begins_ns in reversed(self._history):
            if ends_ns <= from_ns:
                break
            with contextlib.suppress(OSError):  # deleted meanwhile, or no room
                segment.mark(text)
            ends_ns = begins_ns

    def change(self, policy: Policy) -> None:
        """Other limits from now on; folder, mode and format stay."""
        self._policy = replace(policy, root=self._policy.root, mode=self._policy.mode)

    def state(self) -> RecorderState:
        """State of the recording."""
        slow = time.monotonic() - self._dropped_s < SLOW_S
        problems = [self._poses.problem, self._no_room or self._images.problem, self._only_marked]
        problems.append("the disk is slow: images are dropped" if slow else "")
        problem = next(filter(None, problems), "")
        return RecorderState(
            self.folder.name, "" if self.segment is None else self.segment.name, self._used, self.images_dropped,
            problem, bool(self._no_room) or any(w.problem and w.full for w in (self._poses, self._images)),
            max(round((self._newest_ns - max(self._began_ns, 0)) / 1e9), 0),
        )  # fmt: skip

    def close(self, patience_s: float = 2.0) -> None:
        """Write what waits, as far as the disk allows in this time, and close the files."""
        self._over = True
        self._due.set()
        until = time.monotonic() + patience_s
        for writer in (self._poses, self._images):
            writer.close()
        for writer in (self._poses, self._images):
            writer.join(max(until - time.monotonic(), 0.1))
        self._lock.release()

    # -- segments ----------------------------------------------------------------------------------------------------

    def _next_segment_if_due(self, stamp_ns: int) -> None:
        """Begin a new segment when the time or the size of one is reached."""
        if self._began_ns < 0:
            self._began_ns = stamp_ns
            with contextlib.suppress(OSError):
                os.utime(self.folder / RECORDING)  # the beginning by the clock of the disk, for `listed`
        p, written = self._policy, self._images.bytes_written + self._poses.bytes_written
        full = stamp_ns - self._segment_ns >= p.segment_s * 1e9 or written >= p.segment_bytes
        self._newest_ns = stamp_ns
        if self.segment is not None and not (full or self._folder_gone):
            return
        self._folder_gone = False
        self.segment = Segment.of(self.folder, self._number, max(round((stamp_ns - self._began_ns) / 1e9), 0))
        self._number, self._segment_ns = self._number + 1, stamp_ns
        self._due.set()  # the quota is never exceeded by more than a segment, however fast they follow each other
        self._history.append((self.segment, stamp_ns))
        while len(self._history) > 1 and self._history[1][1] <= stamp_ns - int(self._policy.mark_before_s * 1e9):
            self._history.popleft()
        for writer in (self._images, self._poses):
            writer.turn(self.segment)
        for text, until_ns in self._marks.items():
            if stamp_ns <= until_ns:
                with contextlib.suppress(OSError):
                    self.segment.mark(text)

    def _following_missed(self, image: StereoImage) -> StereoImage:
        """An image with the number of images dropped before it, and their inertial and wheel samples."""
        return image.following(self._missed, sum(1 + missed.dropped_before for missed in self._missed))

    # -- the disk ----------------------------------------------------------------------------------------------------

    def _keep_checking(self) -> None:
        while not self._over:
            self._due.wait(EVERY_S)
            self._due.clear()
            self._check_now()

    def _check_now(self) -> None:
        with self._checking, contextlib.suppress(OSError):  # the disk has failed: the writers report it
            self._check_disk()

    def _check_disk(self) -> None:
        p, current = self._policy, self.segment
        if not about(self.folder):
            self._make_folder_again()
        if p.mode == "black_box":
            forget_images(p.root, p.black_box_s, p.segment_s, current)
        excess = make_room(p.root, p.quota, current, self._disk)
        self._used = used_bytes(p.root)
        disk = self._disk(p.root)
        if disk.free < p.quota.min_free:
            least = f"{p.quota.min_free / 1e6:.0f} MB (recording.min_free_gb)"
            self._no_room = f"disk full: {disk.free / 1e6:.0f} MB free, images need {least}"
        elif excess > (0 if current is None else current.bytes):
            kept = "wait for their upload fill the quota" if p.quota.sent_only else "you marked fill the quota"
            self._no_room = f"recordings that {kept}: delete some of them; images are not recorded"
        else:
            self._no_room = ""
            if not self._poses.problem:
                self._keep_reserve()

    def _make_folder_again(self) -> None:
        """Somebody deleted the folder: the recording goes on in another one of its name, and in another segment."""
        with contextlib.suppress(OSError):
            self.folder.mkdir(parents=True, exist_ok=True)
            describe(self.folder, *self._about)
            self._folder_gone = True

    def _make_room_now(self) -> None:
        """The disk refused poses: delete what may be deleted, give up the reserve."""
        with contextlib.suppress(OSError):
            (self._policy.root / RESERVE).unlink(missing_ok=True)
            quota = replace(self._policy.quota, min_free=max(self._policy.quota.min_free, float(RESERVE_BYTES)))
            make_room(self._policy.root, quota, self.segment, self._disk)

    def _keep_reserve(self) -> None:
        """Space that poses can still be written into when others have filled the disk."""
        path = self._policy.root / RESERVE
        with contextlib.suppress(OSError):
            if not path.exists() and self._disk(self._policy.root).free > 4 * RESERVE_BYTES:
                with path.open("wb") as file:
                    os.posix_fallocate(file.fileno(), 0, RESERVE_BYTES)


def _begin_images(rig: Rig, source: str, image_format: str, opening: Opening | None, writer: LogWriter) -> ImageLog:
    write_provenance(
        writer, source=source, serial=rig.serial, mode="record", image_format=image_format, opening=opening
    )
    return ImageLog(writer, rig, None, image_format)


def _run_log(writer: LogWriter, rig: Rig, config: Config, source: str, opening: Opening | None) -> RunLog:
    return RunLog(
        writer, rig, config, source=source, mode="realtime", image_format="none", opening=opening, whole_map=False
    )
