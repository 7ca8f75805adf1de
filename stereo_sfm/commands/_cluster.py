"""Jobs on a Ray cluster that a user has named."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TypeVar

from stereo_sfm.errors import StereoSfmError

T = TypeVar("T")


def on_cluster(results: Iterator[T], address: str | None) -> Iterator[T]:
    """The results of `run_jobs` as they come. Args: address, of the cluster; None: of this computer alone.

    Raises:
        StereoSfmError: there is no cluster at this address, or this computer is no node of it.
    """
    try:
        yield from results
    except (ConnectionError, ValueError, RuntimeError) as error:
        if address is None:
            raise
        raise StereoSfmError(
            f"no Ray cluster at {address} (leave out --address to use this machine): {str(error).splitlines()[0]}"
        ) from None
