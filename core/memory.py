"""Checks that a job fits into memory before it begins."""

from .errors import InputError

# The rest is left to other programs.
_USABLE_SHARE = 0.9


def available() -> int:
    """Bytes of memory that can be used without swapping."""
    import psutil

    return int(psutil.virtual_memory().available)


def require(n_bytes: float, what: str) -> None:
    """Raise `InputError` if `n_bytes` do not fit; `what` needs them, such as ``"a volume of 9 x 9 x 9 voxels"``."""
    usable = _USABLE_SHARE * available()
    if n_bytes > usable:
        raise InputError(
            f"{what} needs {readable_size(n_bytes)} of memory, but {readable_size(usable)} can be used: "
            "choose fewer voxels or pixels, or free some memory"
        )


def readable_size(n_bytes: float) -> str:
    """Bytes as ``"34 KiB"``, ``"12 MiB"`` or ``"3.4 GiB"``."""
    if n_bytes < 2**20:
        return f"{n_bytes / 2**10:.0f} KiB"
    if n_bytes < 2**30:
        return f"{n_bytes / 2**20:.0f} MiB"
    return f"{n_bytes / 2**30:.3g} GiB"
