"""Sealed files of models, checkpoints and samples: tensors, texts and numbers; reading one runs no code of it.

A file is written by `torch.save`, so it is a zip, whose comment holds the SHA-256 of all bytes before the digest.
"""

import hashlib
import io
from pathlib import Path
from typing import Any

import torch

from ..errors import InputError, naming, reading
from ..files import AnyPath, read_bytes, write_bytes

_SEAL = b"mphDRR sha256 "
_DIGEST = 64  # length of the digest, characters
_END = b"PK\x05\x06"  # start of a zip's last record, which has 22 bytes without a comment


class Damaged(InputError):
    """Refusal of a file whose seal is missing, or does not fit its bytes."""


def seal(data: bytes) -> bytes:
    """Return the bytes of a zip without a comment with the seal as its comment."""
    assert data[-22:-18] == _END and data[-2:] == bytes(2)
    data = data[:-2] + (len(_SEAL) + _DIGEST).to_bytes(2, "little") + _SEAL
    return data + hashlib.sha256(data).hexdigest().encode()


def write_sealed(path: AnyPath, content: dict[str, Any]) -> None:
    """Write tensors, texts and numbers into a file with its seal; raise `InputError` if it cannot be written."""
    memory = io.BytesIO()
    torch.save(content, memory)
    write_bytes(path, seal(memory.getvalue()))


def read_sealed(path: Path, kind: str) -> tuple[Any, str]:
    """Return the content of a sealed file, such as a "model file", on the processor, and its digest.

    Raises `Damaged` if its seal is missing or does not fit, and `InputError` if it holds anything but data.
    """
    data = read_bytes(path)
    body, digest = data[:-_DIGEST], data[-_DIGEST:].decode("latin-1")
    if not body.endswith(_SEAL):
        raise Damaged(f"{path}: no {kind} of mphDRR, or cut: its seal is missing")
    if hashlib.sha256(body).hexdigest() != digest:
        raise Damaged(f"{path}: damaged: its bytes are not those that were written")
    with naming(path), reading(path, f"a {kind}: it holds more than numbers and texts, nothing of which was run"):
        return torch.load(io.BytesIO(data), map_location="cpu", weights_only=True), digest
