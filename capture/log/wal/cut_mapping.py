"""Files that another program cuts short while they are mapped here.

A store behind the end of such a file is SIGBUS, which ends the process: everything that is only in
its memory would be lost to somebody's ``truncate``. So the signal's handler puts ordinary memory in
the place of the pages that are gone and notes it; the store then succeeds, and whoever writes the
file ends in good order.
"""

from __future__ import annotations

import ctypes
import mmap
import signal
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass

_LIBC = ctypes.CDLL(None, use_errno=True)
_LIBC.mmap.restype = ctypes.c_void_p
_LIBC.mmap.argtypes = (
    ctypes.c_void_p,
    ctypes.c_size_t,
    ctypes.c_int,
    ctypes.c_int,
    ctypes.c_int,
    ctypes.c_long,
)
_MAP_FIXED = 0x10
_SA_SIGINFO = 4
_BUS_ADRERR = 2  # beyond the end of a mapped file
_ADDRESS_AT = 16  # of si_addr in siginfo_t, on 64-bit systems


class _Action(ctypes.Structure):
    """``struct sigaction`` of glibc and musl."""

    _fields_ = (
        ("handler", ctypes.c_void_p),
        ("mask", ctypes.c_ulong * 16),
        ("flags", ctypes.c_int),
        ("restorer", ctypes.c_void_p),
    )


_HANDLER = ctypes.CFUNCTYPE(None, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)


@dataclass
class _Mapping:
    """One mapped file.

    Attributes:
        address: Where it begins.
        size: Its bytes.
        cut: Called when a store found it cut short; must not store to the mapping.
    """

    address: int
    size: int
    cut: Callable[[], None]


class _Watch:
    """The process's handler of SIGBUS, set with the first mapping."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._mappings: tuple[_Mapping, ...] = ()
        self._handler: object = None

    def add(self, mapping: _Mapping) -> None:
        with self._lock:
            self._mappings = (*self._mappings, mapping)
            if self._handler is None:
                self._set_handler()

    def remove(self, mapping: _Mapping) -> None:
        with self._lock:
            self._mappings = tuple(each for each in self._mappings if each is not mapping)

    def _set_handler(self) -> None:
        """Where the system allows no callbacks from C, SIGBUS ends the process as it always did."""
        if sys.platform != "linux" or sys.maxsize < 2**32:
            return
        try:
            handler = _HANDLER(self._on_signal)
        except MemoryError:
            return
        action = _Action(ctypes.cast(handler, ctypes.c_void_p), flags=_SA_SIGINFO)
        if not _LIBC.sigaction(int(signal.SIGBUS), ctypes.byref(action), None):
            self._handler = handler

    def _on_signal(self, number: int, info: int, context: int) -> None:
        """Runs in the thread whose store failed, in the middle of that store."""
        del context
        code = ctypes.c_int.from_address(info + 8).value
        address = ctypes.c_size_t.from_address(info + _ADDRESS_AT).value
        for mapping in self._mappings:
            within = address - mapping.address
            if code == _BUS_ADRERR and 0 <= within < mapping.size:
                page = address & -mmap.PAGESIZE
                left = mapping.address + mapping.size - page
                access = mmap.PROT_READ | mmap.PROT_WRITE
                kind = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | _MAP_FIXED
                if _LIBC.mmap(page, left, access, kind, -1, 0) == page:
                    mapping.cut()
                    return
        default = _Action(None)
        _LIBC.sigaction(number, ctypes.byref(default), None)  # the store fails again, and ends us
        if code != _BUS_ADRERR:
            signal.raise_signal(number)


_WATCH = _Watch()


def watch_mapping(address: int, size: int, cut: Callable[[], None]) -> Callable[[], None]:
    """Keep a mapped file's process alive when the file is cut short.

    Args:
        address: Where the mapping begins.
        size: Its bytes.
        cut: Called, in the thread that stored, when a store found the file too short; must not
            store to the mapping. What is stored there from then on is only in memory.

    Returns:
        Ends the watch; to be called before the mapping goes.
    """
    mapping = _Mapping(address, size, cut)
    _WATCH.add(mapping)
    return lambda: _WATCH.remove(mapping)
