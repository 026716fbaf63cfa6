"""Paths of local files and of objects in an object store (s3://bucket/key), behind one interface.

Sources and stores may be in either. The credentials and the endpoint of an object store come from the environment
(AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_ENDPOINT_URL); they are never part of a path or of a product.
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

from romandask.model.cache import cache_folder
from romandask.model.errors import UserError

AnyPath = Path
"""Path of a file or a folder: a Path, or a UPath, which has the same methods and is annotated as a Path."""
SCHEMES = ("s3",)
"""URL schemes that are accepted. Others are untested with respect to partial reads and concurrent writers."""
OPTIONS: dict[str, Any] = {"use_listings_cache": False}
"""fsspec options: no cache of folder listings, because other processes write to the store as well."""
_OBJECTS_PER_REQUEST = 500
"""Number of objects that are fetched concurrently."""


def parse_path(text: str | AnyPath, what: str = "a store") -> AnyPath:
    """Return the absolute path for a path or URL given by a user.

    Parameters
    ----------
    text : str or path
        Local path, or s3://BUCKET/FOLDER.
    what : str
        What the path is for, as error messages name it.

    Raises
    ------
    UserError
        If the URL has an unknown scheme, names no bucket, contains characters or parts that are not allowed, or if
        s3fs is not installed.
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
    path: Any = UPath(f"{scheme}://{'/'.join(parts)}", **OPTIONS)
    return path


@contextmanager
def access_errors_explained(path: AnyPath) -> Iterator[None]:
    """Turn errors of an object store (no such bucket, no answer, no credentials) into a UserError.

    Errors for local paths pass unchanged.
    """
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        # botocore has about a hundred exception classes without a common base; each message is one clear line
        if isinstance(path, Path):
            raise
        raise UserError(
            f"{path}: cannot be reached ({str(error) or type(error).__name__}): look at the bucket's name and at "
            "AWS_ENDPOINT_URL, AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY"
        ) from None


def resolve_below(folder: AnyPath, text: str | AnyPath) -> AnyPath:
    """Return the path of a source: a path relative to a folder, an absolute path, or a URL."""
    return parse_path(text, "a source") if "://" in str(text) else folder / str(text)


def local_copy(path: AnyPath) -> Path:
    """Return a local file with the content of a path: the path itself, or a cached copy of an object.

    Copies are cached under the object's URL and its ETag, size and time (see `romandask.model.cache.cache_folder`), so
    that the processes of one machine fetch an object once.

    Raises
    ------
    UserError
        If there is no folder that can be written.
    """
    if isinstance(path, Path):
        return path
    tag = hashlib.blake2b(f"{path}\n{_tag(path)}".encode(), digest_size=12).hexdigest()
    cache = cache_folder("inputs")
    if cache is None:
        raise UserError(f"{path}: there is no folder for a copy: set XDG_CACHE_HOME to one that can be written")
    copy = cache / tag / path.name
    if not copy.exists():
        copy.parent.mkdir(parents=True, exist_ok=True)
        partial = copy.with_name(f".{uuid.uuid4().hex}.partial")
        try:
            path.fs.get_file(path.path, str(partial))
            os.replace(partial, copy)
        finally:
            partial.unlink(missing_ok=True)
    return copy


def file_state(path: AnyPath) -> list[int]:
    """Return the size (bytes) and the modification time (ns) of a file, by which changes are detected."""
    status = path.stat()
    return [int(status.st_size), int(status.st_mtime_ns)]


def modification_time(path: AnyPath) -> float:
    """Return the modification time of a file, s, by the clock of the computer that holds it."""
    if not isinstance(path, Path):
        return float(path.fs.modified(path.path).timestamp())
    # a network file system asks its server for the state of a file that is opened
    with open(path, "rb") as file:
        return os.fstat(file.fileno()).st_mtime


def write_bytes(path: AnyPath, content: bytes) -> None:
    """Write a file atomically: it appears complete or not at all."""
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
    """Create a file; raise FileExistsError if it exists, also if another process creates it at the same time."""
    if isinstance(path, Path):
        with open(path, "xb") as file:
            file.write(content)
    else:
        path.fs.pipe_file(path.path, content, mode="create")


def remove(path: AnyPath) -> None:
    """Remove a file if it exists."""
    if isinstance(path, Path):
        path.unlink(missing_ok=True)
    else:
        path.fs.rm_file(path.path)


def remove_folder(path: AnyPath) -> None:
    """Remove a folder and its content if it exists."""
    if isinstance(path, Path):
        shutil.rmtree(path, ignore_errors=True)
    elif path.exists():
        path.fs.rm(path.path, recursive=True)


def file_names(folder: AnyPath, ending: str) -> list[str]:
    """Return the names, without the suffix `ending`, of the files in a folder that have this suffix, sorted.

    Hidden files are left out. A folder that does not exist has no files.
    """
    try:
        if isinstance(folder, Path):
            names = os.listdir(folder)
        else:
            names = [key.rsplit("/", 1)[-1] for key in folder.fs.ls(folder.path, detail=False)]
    except (FileNotFoundError, NotADirectoryError):
        return []
    return sorted(name.removesuffix(ending) for name in names if name.endswith(ending) and not name.startswith("."))


def read_files(folder: AnyPath, ending: str) -> Iterator[tuple[str, bytes]]:
    """Yield the names, without the suffix `ending`, and the contents of the files in a folder that have this suffix.

    Objects are fetched many at a time.
    """
    names = file_names(folder, ending)
    if isinstance(folder, Path):
        for name in names:
            # another process may have removed it since the folder was listed
            with suppress(FileNotFoundError):
                yield name, (folder / f"{name}{ending}").read_bytes()
        return
    for start in range(0, len(names), _OBJECTS_PER_REQUEST):
        keys = {(folder / f"{name}{ending}").path: name for name in names[start : start + _OBJECTS_PER_REQUEST]}
        for key, content in folder.fs.cat(list(keys), on_error="omit").items():
            yield keys[key], content


def bytes_below(folder: AnyPath) -> int:
    """Return the total size, bytes, of all files below a folder."""
    if isinstance(folder, Path):
        return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    return int(folder.fs.du(folder.path))


def files_below(folder: AnyPath) -> list[AnyPath]:
    """Return all files below a folder, sorted."""
    if isinstance(folder, Path):
        return sorted(path for path in folder.rglob("*") if path.is_file())
    return [folder.joinpath(key.removeprefix(f"{folder.path}/")) for key in sorted(folder.fs.find(folder.path))]


def _tag(path: Any) -> str:
    info = path.fs.info(path.path)
    return f"{info.get('ETag')} {info.get('size')} {info.get('LastModified')}"
