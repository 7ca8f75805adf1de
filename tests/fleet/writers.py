"""Writers that exchange one object at the same time."""

from __future__ import annotations

import threading

from stereo_sfm.storage import objects
from stereo_sfm.storage.objects import Changed
from stereo_sfm.storage.remote import Remote


def winners(target: Remote, turn: int, tag: str | None, count: int) -> list[int]:
    """Which of the writers 0 to `count` - 1 exchanged the object with `tag` for their own "TURN WRITER"."""
    won: list[int] = []

    def write(k: int) -> None:
        try:
            objects.exchange(target, f"{turn} {k}".encode(), tag)
            won.append(k)
        except Changed:
            pass

    threads = [threading.Thread(target=write, args=(k,)) for k in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return won
