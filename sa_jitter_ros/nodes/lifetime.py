# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
How a process of nodes ends: at the first SIGINT or SIGHUP, and soon, whatever the middleware does.

A hanging call of the middleware holds the lock of the Python interpreter: no Python thread can end
the process then. A timer of the C library does, whose threads call functions of C.
"""

import atexit
from collections.abc import Iterator
from contextlib import contextmanager
import ctypes
import signal
import threading
import time
from types import FrameType

SECONDS = 3.0  # for the middleware, after the state of the nodes is kept
_AFTERWARDS = 1.0  # s more for the end of Python
_EXIT = 0.2  # s between the line that says so and the end
_SOON = 0.5  # s in which a process ends that has nothing else to do
_MONOTONIC, _THREAD = 1, 2  # CLOCK_MONOTONIC, SIGEV_THREAD


def in_main_thread() -> bool:
    """Return whether this is the thread that handles signals."""
    return threading.current_thread() is threading.main_thread()


class _Event(ctypes.Structure):
    """`struct sigevent`: what a timer calls, with which value."""

    _fields_ = [('value', ctypes.c_void_p), ('number', ctypes.c_int), ('notify', ctypes.c_int),
                ('function', ctypes.c_void_p), ('rest', ctypes.c_char * 40)]


class _Times(ctypes.Structure):
    """`struct itimerspec`: interval and time, in seconds and nanoseconds each."""

    _fields_ = [(name, ctypes.c_long) for name in ('every', 'every_ns', 'after', 'after_ns')]


class InterruptOnce:
    """
    A handler that interrupts Python once; later signals find it ending already.

    It takes SIGINT, and SIGHUP of a terminal that is closed unless `nohup` has it ignored.
    """

    def __init__(self) -> None:
        self.ending = False
        if in_main_thread():
            ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
            for number in (signal.SIGINT,) if ignored else (signal.SIGINT, signal.SIGHUP):
                signal.signal(number, self)
                # Python takes its handlers away when it ends.
                atexit.register(signal.signal, number, signal.SIG_IGN)

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Interrupt what runs, the first time."""
        if not self.ending:
            self.ending = True
            raise KeyboardInterrupt


def _arm(seconds: float, text: ctypes.Array[ctypes.c_char]) -> list[ctypes.c_void_p]:
    """Start timers that write a text and end the process; return them."""
    library = ctypes.CDLL(None)
    timers: list[ctypes.c_void_p] = []
    calls = ((seconds, 'warnx', ctypes.addressof(text)), (seconds + _EXIT, '_exit', 0))
    possible = in_main_thread() and hasattr(library, 'timer_create')
    for after, name, value in calls if possible else ():
        function = ctypes.cast(getattr(library, name), ctypes.c_void_p)
        event, timer = _Event(value, 0, _THREAD, function), ctypes.c_void_p()
        if library.timer_create(_MONOTONIC, ctypes.byref(event), ctypes.byref(timer)) == 0:
            whole = int(after)
            library.timer_settime(timer, 0, ctypes.byref(
                _Times(0, 0, whole, round(1e9 * (after - whole)))), None)
            timers.append(timer)
    return timers


@contextmanager
def end_within(seconds: float) -> Iterator[ctypes.Array[ctypes.c_char]]:
    """
    End the process with status 0 if the block, and the end of Python after it, take longer.

    It writes the text of the yielded buffer to the standard error first: what the block does. The
    process has to be that of the nodes: nothing happens in another thread than the main one, nor
    at the end of a Python that goes on for a while after the block.
    """
    text, deadline = ctypes.create_string_buffer(200), time.monotonic() + seconds
    timers = _arm(seconds, text)
    try:
        yield text
    finally:
        for timer in timers:
            ctypes.CDLL(None).timer_delete(timer)
    done = time.monotonic()

    def at_exit() -> None:
        now = time.monotonic()
        if now - done < _SOON:
            ctypes.pythonapi.Py_IncRef(ctypes.py_object(text))  # Python takes it away else
            _arm(max(deadline - now, 0.0) + _AFTERWARDS, text)
    atexit.register(at_exit)
