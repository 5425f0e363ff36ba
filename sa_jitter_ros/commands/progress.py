# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The progress of a command on the standard error: a bar on a terminal, else a line at times."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
import sys
from threading import Event, Thread
import time

_REDRAW, _LINE = 0.2, 10.0  # s between two bars, two lines
_TICK = 1.0  # s between two looks at a step that takes long
_WIDTH = 24


class Progress:
    """Shows how much of the work of a program is done, unless `quiet`."""

    def __init__(self, program: str, *, quiet: bool = False) -> None:
        self._program, self._quiet = program, quiet
        self._bar = sys.stderr.isatty()
        self._start = self._last = time.monotonic()
        self._drawn = False

    @contextmanager
    def ticking(self) -> Iterator[None]:
        """Show meanwhile, unless `quiet`, that the program works: it need not tell its share."""
        if self._quiet:
            yield
            return
        self.tick()
        ended = Event()

        def tick() -> None:
            while not ended.wait(_TICK):
                self.tick()

        thread = Thread(target=tick, daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()
            self.clear()

    def step(self, text: str) -> None:
        """Show a line for a step that begins or a result, unless `quiet`."""
        if not self._quiet:
            self.say(text)
        self._last = time.monotonic()

    def tick(self) -> None:
        """Show for how long the program has worked, on no terminal only if a step takes long."""
        self._draw(f'working, {time.monotonic() - self._start:.0f} s', 0.0)

    def show(self, share: float, text: str) -> None:
        """Show the share that is done (0 to 1), and a text."""
        past = time.monotonic() - self._start
        left = past * (1.0 / share - 1.0) if share > 0.0 else float('inf')
        line = f'{share:4.0%}  {text}' + (f'  {left:.0f} s left' if left < 1e6 else '')
        if self._bar:
            full = round(_WIDTH * min(share, 1.0))
            line = f'[{"#" * full}{"." * (_WIDTH - full)}] {line}'
        self._draw(line, _REDRAW)

    def _draw(self, line: str, pause: float) -> None:
        """Show a line that the next one replaces, after a pause (s); on no terminal at times."""
        now = time.monotonic()
        if not self._quiet and now - self._last >= (pause if self._bar else _LINE):
            self._last = now
            self._write(f'{self._program}: {line}', end='' if self._bar else '\n')
            self._drawn = self._bar

    def say(self, line: str) -> None:
        """Show a line that stays, also if quiet."""
        self.clear()
        self._write(f'{self._program}: {line}', end='\n')

    def clear(self) -> None:
        """Remove the bar."""
        if self._drawn:
            self._write('', end='')
        self._drawn = False

    def _write(self, line: str, *, end: str) -> None:
        with suppress(OSError):  # the work goes on if nobody can read it
            print(f'\r\033[K{line}' if self._bar else line, end=end, file=sys.stderr, flush=True)
