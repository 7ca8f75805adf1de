"""Objects in buckets: read, write, exchange on a condition, list, delete. Every failure is one line.

Credentials come from where obstore looks for them: the environment (AWS_ACCESS_KEY_ID, GOOGLE_APPLICATION_CREDENTIALS,
AZURE_STORAGE_ACCOUNT_NAME, ...) or the computer's own role; profiles of AWS need boto3. No message repeats what the
server or the library says, besides the code of the error: it might contain them.
"""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import json
import os
import re
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from contextvars import ContextVar
from datetime import date, timedelta
from pathlib import Path, PurePosixPath
from typing import Any, Literal

from stereo_sfm.errors import Hindered, StereoSfmError, require
from stereo_sfm.folder_lock import FolderLock
from stereo_sfm.storage.remote import Remote

TRIES = 12  # of a request: a tenth of failing answers makes an object fail once in 10^12
PATIENCE_S = 180.0  # for all tries of a request: a server that stands still for 20 s costs nothing
CONNECT_S, REQUEST_S = 5.0, 60.0
EMULATOR = "STORAGE_EMULATOR_HOST"  # of Google's own libraries: the address of another server than theirs
PARTS_AT_ONCE = 2  # of a large object, 5 MiB each: within `REQUEST_S` at 1.4 Mbit/s
# What the server or the system answered, in a message that names the object and its address, too.
ANSWER = re.compile(r"status code: .*|\(os error \d+\)", re.DOTALL)
FULL = re.compile(r"QuotaExceeded|StorageFull|InsufficientStorage|^status code: 507\b|os error 28\b", re.I)
DENIED = re.compile(r"AccessDenied|InvalidAccessKeyId|SignatureDoesNotMatch|^status code: 40[13]\b|os error 13\b", re.I)
NO_BUCKET = re.compile(r"NoSuchBucket|ContainerNotFound|The specified bucket does not exist", re.I)
NO_CREDENTIALS = re.compile(r"credential|service account|account must be specified|169\.254\.169\.254", re.I)
CREDENTIALS = {"s3": "AWS_ACCESS_KEY_ID", "gs": "GOOGLE_APPLICATION_CREDENTIALS", "az": "AZURE_STORAGE_ACCOUNT_NAME"}
REFUSED_NAME = re.compile(r'Path "(.*?)"(?: contained empty|: Encountered)', re.DOTALL)
CODE = re.compile(r"<Code>(\w+)</Code>|^status code: ([45]\d\d [A-Z][A-Za-z ]+)")


class Missing(StereoSfmError):
    """There is no such object."""


class Changed(StereoSfmError):
    """Somebody else has written the object meanwhile."""


class Refused(Hindered):
    """There is no bucket, no right, no room, or no credentials."""


class Denied(Refused):
    """The credentials give no right to it."""


class Unreachable(Hindered):
    """The network or the server failed for longer than `PATIENCE_S`."""


_patience_s: ContextVar[float] = ContextVar("patience", default=PATIENCE_S)


@contextmanager
def patience(seconds: float) -> Generator[None]:
    """Give up a request after so long, in this thread and block, or sooner where nothing at all arrives."""
    before = _patience_s.set(seconds)
    try:
        yield
    finally:
        _patience_s.reset(before)


@functools.cache
def _store(scheme: str, bucket: str, patience_s: float) -> Any:
    require(("obstore",), "fleet", f"{scheme}://")
    from obstore.store import LocalStore, from_url

    if scheme == "file":
        return LocalStore(prefix=Path("/"), automatic_cleanup=False, mkdir=True)
    options: dict[str, Any] = {}
    if scheme == "s3" and "AWS_ACCESS_KEY_ID" not in os.environ and importlib.util.find_spec("boto3") is not None:
        from botocore.exceptions import BotoCoreError
        from obstore.auth.boto3 import Boto3CredentialProvider

        try:
            with contextlib.suppress(ValueError):  # boto3 knows none: the computer's own role is asked for
                options["credential_provider"] = Boto3CredentialProvider()
        except BotoCoreError as error:
            raise ValueError(f"credentials: {type(error).__name__}") from None
    emulator = os.environ.get(EMULATOR, "") if scheme == "gs" else ""
    if emulator:
        options["service_account_key"] = json.dumps(
            {
                "gcs_base_url": emulator,
                "disable_oauth": True,
                "client_email": "",
                "private_key": "",
                "private_key_id": "",
            }
        )
    plain = (emulator or os.environ.get("AWS_ENDPOINT_URL", "")).startswith("http://")
    silent = timedelta(seconds=min(REQUEST_S, patience_s))  # what arrives slowly may take longer
    client = {"connect_timeout": min(timedelta(seconds=CONNECT_S), silent), "read_timeout": silent}
    client["timeout"] = timedelta(seconds=REQUEST_S)
    options["client_options"] = {**client, **({"allow_http": True} if plain else {})}
    options["retry_config"] = {
        "max_retries": TRIES,
        "retry_timeout": timedelta(seconds=patience_s),
        "backoff": {"init_backoff": timedelta(seconds=0.1), "max_backoff": timedelta(seconds=10), "base": 2},
    }
    return from_url(f"{scheme}://{bucket}", **options)


@contextmanager
def _opened(remote: Remote, doing: str) -> Generator[Any]:
    """The store of an object; every error of the library as one of ours."""
    require(("obstore",), "fleet", f"{remote.scheme}://")
    from obstore import exceptions as obx

    try:
        yield _store(remote.scheme, remote.bucket, _patience_s.get())
    except (obx.AlreadyExistsError, obx.PreconditionError):
        raise Changed(f"{remote} was written by another program meanwhile") from None
    except InterruptedError:  # not of the network: what was to be written was stopped
        raise
    except (obx.BaseError, OSError, ValueError) as error:
        named = _named(remote, doing, error, obx)
        if doing == "read" and isinstance(named, Denied) and _lacks(remote):
            named = Missing(f"there is no {remote}")
        raise named from None


def _lacks(remote: Remote) -> bool:
    """Whether the list of its folder lacks an object. S3 denies what is missing to those who may list a prefix only."""
    folder = remote.parent
    with contextlib.suppress(StereoSfmError), _opened(folder, "list") as store:
        found = store.list_with_delimiter(prefix=folder.key or None)["objects"]
        return remote.key not in [str(m["path"]) for m in found]
    return False


def _named(remote: Remote, doing: str, error: BaseException, obx: Any) -> StereoSfmError:
    said = str(error).partition("\n\nDebug source")[0].replace(f"/{remote.key}", "")
    found = ANSWER.search(said)
    answer = found[0] if found else ""
    if NO_BUCKET.search(answer):
        return Refused(f"there is no bucket {remote.scheme}://{remote.bucket}: create it, or correct the name")
    if isinstance(error, FileNotFoundError | obx.NotFoundError):
        return Missing(f"there is no {remote}")
    if FULL.search(answer):  # before the rights: some servers answer 403 to what exceeds a limit
        return Refused(f"cannot {doing} {remote}: the storage is full: delete something, or raise its limit")
    denied = (PermissionError, obx.PermissionDeniedError, obx.UnauthenticatedError)
    if isinstance(error, denied) or DENIED.search(answer):
        return Denied(
            f"no right to {doing} {remote}: check the credentials in the environment, and the rights of this prefix"
        )
    if NO_CREDENTIALS.search(said):
        where = CREDENTIALS.get(remote.scheme, "")
        return Refused(f"no credentials for {remote.scheme}://: set them in the environment ({where})")
    refused = REFUSED_NAME.search(str(error)) if isinstance(error, ValueError | obx.InvalidPathError) else None
    if refused:
        return StereoSfmError(
            f"cannot {doing} {remote}: the object {refused[1]!r} has nothing, dots or odd characters between two"
            " slashes: give it another name, or delete it"
        )
    code = CODE.search(answer)
    why = (code[1] or code[2]) if code else "no answer"
    return Unreachable(f"cannot {doing} {remote}: {why}, although it was tried again and again")


def read(remote: Remote) -> bytes:
    """The content of an object.

    Raises:
        Missing: there is none. StereoSfmError: it cannot be read.
    """
    return read_tagged(remote)[0]


def read_tagged(remote: Remote) -> tuple[bytes, str]:
    """The content of an object and the tag of this content."""
    with _opened(remote, "read") as store:
        found = store.get(remote.key)
        return bytes(found.bytes()), str(found.meta[_condition(remote)])


def _condition(remote: Remote) -> Literal["version", "e_tag"]:
    """What a conditional put compares."""
    return "version" if remote.scheme == "gs" else "e_tag"


def size_and_tag(remote: Remote) -> tuple[int, str]:
    """Bytes of an object, and the tag of its content.

    Raises:
        Missing: there is none.
    """
    with _opened(remote, "read") as store:
        meta = store.head(remote.key)
        return int(meta["size"]), str(meta["e_tag"])


def written(remote: Remote) -> date:
    """The day on which an object was written, in UTC."""
    with _opened(remote, "read") as store:
        return store.head(remote.key)["last_modified"].date()


def exists(remote: Remote) -> bool:
    """Whether there is an object of this name."""
    try:
        size_and_tag(remote)
    except Missing:
        return False
    return True


def read_range(remote: Remote, start: int, length: int) -> bytes:
    """A part of an object."""
    with _opened(remote, "read") as store:
        return bytes(store.get_range(remote.key, start=start, length=length))


def read_ranges(remote: Remote, ranges: Iterable[tuple[int, int]]) -> list[bytes]:
    """Parts of an object, each (start, length), by requests of their own: nothing between them is read."""
    wanted = [(start, length) for start, length in ranges if length > 0]
    if not wanted:
        return []
    starts, lengths = [start for start, _ in wanted], [length for _, length in wanted]
    with _opened(remote, "read") as store:
        found = store.get_ranges(remote.key, starts=starts, lengths=lengths, coalesce=0)
        return [bytes(part) for part in found]


def write(remote: Remote, data: bytes | Path | Iterable[bytes]) -> None:
    """Write an object whole: nobody sees a part of it."""
    with _opened(remote, "write") as store:
        store.put(remote.key, data, max_concurrency=PARTS_AT_ONCE)


def create(remote: Remote, data: bytes) -> None:
    """Write an object that does not exist yet; one with this content already is as good.

    Raises:
        Changed: there is one with another content.
    """
    _conditional(remote, data, None)


def exchange(remote: Remote, data: bytes, tag: str | None) -> None:
    """Replace an object if its content is still the one with this tag; None: if there is none.

    A try whose answer was lost may have succeeded: content that equals `data` counts as written by this call, so it
    should name its writer.

    Raises:
        Changed: another program was faster.
    """
    _conditional(remote, data, tag)


def _conditional(remote: Remote, data: bytes, tag: str | None) -> None:
    try:
        if remote.scheme == "file":
            _exchange_file(remote, data, tag)
            return
        with _opened(remote, "write") as store:
            mode: Any = "create" if tag is None else {_condition(remote): tag}
            store.put(remote.key, data, mode=mode, use_multipart=False)
    except (Changed, Unreachable):
        with contextlib.suppress(Missing):
            if read(remote) == data:
                return
        raise


def _exchange_file(remote: Remote, data: bytes, tag: str | None) -> None:
    """The same on a file system, which has no such request: under a lock of the folder."""
    folder = Path("/") / Path(remote.key).parent
    with _opened(remote, "write"):
        folder.mkdir(parents=True, exist_ok=True)
    try:
        held = FolderLock(folder, "try again")
    except StereoSfmError:
        raise Changed(f"{remote} is being written by another program") from None
    with held:
        try:
            before = size_and_tag(remote)[1]
        except Missing:
            before = None
        if before != tag:
            raise Changed(f"{remote} was written by another program meanwhile")
        write(remote, data)


def listed(remote: Remote) -> list[tuple[str, int, str]]:
    """(name below it, bytes, tag) of every object in a folder, by name; no empty ones that stand for a folder.

    Raises:
        StereoSfmError: there is no such bucket, or no right to list it.
    """
    prefix = f"{remote.key}/" if remote.key else ""
    with _opened(remote, "list") as store:
        found = [m for page in store.list(prefix=prefix or None) for m in page]
    inside = [m for m in found if str(m["path"]).startswith(prefix)]
    rows = [(str(m["path"])[len(prefix) :], int(m["size"]), str(m["e_tag"])) for m in inside]
    above = {str(parent) for name, _, _ in rows for parent in PurePosixPath(name).parents}
    return sorted(row for row in rows if row[1] or row[0] not in above)


def folders(remote: Remote) -> list[str]:
    """The names of the folders in a folder."""
    prefix = f"{remote.key}/" if remote.key else ""
    with _opened(remote, "list") as store:
        found = store.list_with_delimiter(prefix=prefix or None)["common_prefixes"]
    return sorted(str(name).rstrip("/").rpartition("/")[2] for name in found)


def delete(remotes: Iterable[Remote]) -> None:
    """Remove objects; those that are gone already are as good."""
    for remote in remotes:
        with contextlib.suppress(Missing), _opened(remote, "delete") as store:
            store.delete(remote.key)
