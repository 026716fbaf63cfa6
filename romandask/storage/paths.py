"""Places: files of this machine and of object stores (s3://bucket/key), by one interface.

What is read of sources and what a store holds may be either. Credentials and the address of the service are those of
the environment (AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_ENDPOINT_URL), never part of a name or of a product.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from upath import UPath

from romandask.model.errors import UserError

AnyPath = Path
"""A file or a folder: a Path, or a UPath, which has its methods and is said to be one."""
SCHEMES = ("s3",)
"""Of addresses that are taken; what others do with parts of files and with two writers has not been tried."""
OPTIONS: dict[str, Any] = {"use_listings_cache": False}
"""Other processes write too: what a folder holds is asked anew each time."""
_AT_ONCE = 500
"""Objects that are asked for together."""


def parse_path(text: str | AnyPath, what: str = "a store") -> AnyPath:
    """Return the place that a user names, absolute.

    Raises
    ------
    UserError
        If it is an address of a kind that is not known, names no bucket or leads out of it, or if what reads it is not
        installed.
    """
    if "://" not in str(text):
        return Path(text).resolve()
    scheme, _, key = str(text).partition("://")
    if scheme not in SCHEMES:
        raise UserError(f"{text}: {what} is a folder, or s3://BUCKET/FOLDER; {scheme}:// is not known")
    parts = key.rstrip("/").split("/")
    if not all(parts) or {".", ".."} & set(parts) or any(letter in key for letter in "?#*[]"):
        raise UserError(f"{text}: {what} is s3://BUCKET/FOLDER, without empty parts, . and .., and ? # * [ ]")
    if importlib.util.find_spec("s3fs") is None:
        raise UserError(f"{text}: s3fs is not installed: pip install 'romandask[s3]'")
    found: Any = UPath(f"{scheme}://{'/'.join(parts)}", **OPTIONS)
    return found


@contextmanager
def access_errors_explained(place: AnyPath) -> Iterator[None]:
    """Turn what goes wrong with an object store (no such bucket, no answer, no credentials) into a UserError."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        # botocore has a hundred kinds; all of them say in a line what is wrong
        if isinstance(place, Path):
            raise
        raise UserError(
            f"{place}: cannot be reached ({str(error) or type(error).__name__}): look at the bucket's name and at "
            "AWS_ENDPOINT_URL, AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY"
        ) from None


def resolve_below(folder: AnyPath, text: str | AnyPath) -> AnyPath:
    """Return a place that is named from a folder, or by itself: an absolute path, an address."""
    return parse_path(text, "a source") if "://" in str(text) else folder / str(text)


def local_copy(path: AnyPath) -> Path:
    """Return a file of this machine with the content of another: itself, or a copy of an object.

    Copies are kept by their content's tag, in the folder `romandask` of the user's cache (XDG_CACHE_HOME), so that the
    processes of a machine fetch an object once.
    """
    if isinstance(path, Path):
        return path
    tag = hashlib.blake2b(f"{path}\n{_tag(path)}".encode(), digest_size=12).hexdigest()
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "romandask" / "inputs"
    found = cache / tag / path.name
    if not found.exists():
        found.parent.mkdir(parents=True, exist_ok=True)
        partial = found.with_name(f".{uuid.uuid4().hex}.partial")
        try:
            path.fs.get_file(path.path, str(partial))
            os.replace(partial, found)
        finally:
            partial.unlink(missing_ok=True)
    return found


def file_state(path: AnyPath) -> list[int]:
    """Return what tells whether a file has changed: its bytes and the time (ns) at which it was written."""
    found = path.stat()
    return [int(found.st_size), int(found.st_mtime_ns)]


def write_bytes(path: AnyPath, content: bytes) -> None:
    """Write a file so that it appears whole or not at all."""
    if not isinstance(path, Path):
        path.fs.pipe_file(path.path, content)
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.partial")
    with open(temporary, "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)


def write_new(path: AnyPath, content: bytes) -> None:
    """Write a file that is not there yet; FileExistsError where it is, whoever else tries at the same time."""
    if isinstance(path, Path):
        with open(path, "xb") as file:
            file.write(content)
    else:
        path.fs.pipe_file(path.path, content, mode="create")


def remove(path: AnyPath) -> None:
    """Remove a file, if it is there."""
    if isinstance(path, Path):
        path.unlink(missing_ok=True)
    else:
        path.fs.rm_file(path.path)


def remove_folder(path: AnyPath) -> None:
    """Remove a folder and what it holds, if it is there."""
    if isinstance(path, Path):
        shutil.rmtree(path, ignore_errors=True)
    elif path.exists():
        path.fs.rm(path.path, recursive=True)


def file_names(folder: AnyPath, ending: str) -> list[str]:
    """Return the names, less an ending, of the files of a folder that have it; none where there is no folder."""
    try:
        if isinstance(folder, Path):
            names = os.listdir(folder)
        else:
            names = [key.rsplit("/", 1)[-1] for key in folder.fs.ls(folder.path, detail=False)]
    except FileNotFoundError:
        return []
    return sorted(name.removesuffix(ending) for name in names if name.endswith(ending) and not name.startswith("."))


def read_files(folder: AnyPath, ending: str) -> Iterator[tuple[str, bytes]]:
    """Yield the names, less an ending, and the bytes of the files of a folder that have it: of objects many at once."""
    names = file_names(folder, ending)
    if isinstance(folder, Path):
        for name in names:
            # one that a run has just removed is not there
            with suppress(FileNotFoundError):
                yield name, (folder / f"{name}{ending}").read_bytes()
        return
    for start in range(0, len(names), _AT_ONCE):
        keys = {(folder / f"{name}{ending}").path: name for name in names[start : start + _AT_ONCE]}
        for key, content in folder.fs.cat(list(keys), on_error="omit").items():
            yield keys[key], content


def bytes_below(folder: AnyPath) -> int:
    """Return the bytes of all files below a folder."""
    if isinstance(folder, Path):
        return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    return int(folder.fs.du(folder.path))


def files_below(folder: AnyPath) -> list[AnyPath]:
    """Return all files below a folder, in order."""
    if isinstance(folder, Path):
        return sorted(path for path in folder.rglob("*") if path.is_file())
    return [folder.joinpath(key.removeprefix(f"{folder.path}/")) for key in sorted(folder.fs.find(folder.path))]


def _tag(path: Any) -> str:
    found = path.fs.info(path.path)
    return f"{found.get('ETag')} {found.get('size')} {found.get('LastModified')}"
