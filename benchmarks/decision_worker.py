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
Closes the loop on recordings in files, with whatever version of the package is imported.

As a program it reads one job a line from the standard input and writes one answer a line, both as
JSON. It needs nothing of this folder, so that versions can be compared on the same recordings.
"""

from collections.abc import Mapping, Sequence
import contextlib
from html import unescape
import json
from pathlib import Path
import re
import signal
import sys
import time
import traceback
from types import FrameType
from typing import Any
import warnings

LIMIT = 120.0  # s of the processor, for a recording


class TooLong(Exception):
    """The loop has not ended within `LIMIT`."""


def answer(files: Sequence[str], declared: str, *, again: bool = False, page: bool = False
           ) -> Mapping[str, Any]:
    """
    Close the loop on files; return `report`, the `text` of all that it says, or `error`.

    With `again`, what the report declares is declared for a second time; with `page` the text is
    that of `report.html`, too.
    """
    from sa_jitter_ros.errors import SaJitterError
    from sa_jitter_ros.loop import close_loop

    start = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        try:
            loop = close_loop(files, declared)
            if again and loop.report['parameter_file']:
                Path(declared).write_text(loop.report['parameter_file'], encoding='utf-8')
                loop = close_loop(files, declared)
        except SaJitterError as error:
            return {'error': str(error).replace(f'{Path(declared).parent}/', ''),
                    'seconds': time.process_time() - start}
        seconds = time.process_time() - start
        text = [str(loop), *_sentences(loop.report)]
        if page:
            folder = Path(declared).parent / 'report'
            loop.write(folder)
            text.append(_plain_text((folder / 'report.html').read_text(encoding='utf-8')))
    return {'report': json.loads(json.dumps(loop.report)), 'text': '\n'.join(text),
            'seconds': seconds}


def _plain_text(html: str) -> str:
    return unescape(re.sub(r'<style.*?</style>|<script.*?</script>|<[^>]*>', ' ', html,
                           flags=re.DOTALL))


def _sentences(report: Mapping[str, Any]) -> list[str]:
    """Return what the report says in plain words, as far as this version has such functions."""
    from sa_jitter_ros.report import words

    found = []
    for name in ('verdict_sentence', 'next_steps'):
        said = getattr(words, name, lambda _: '')(report)
        found += [said] if isinstance(said, str) else list(said)
    return found


def _stop(number: int, frame: FrameType | None) -> None:
    raise TooLong(f'not done after {LIMIT:g} s')


def main() -> None:
    """Answer each line of the standard input, whatever happens."""
    signal.signal(signal.SIGPROF, _stop)
    for line in sys.stdin:
        signal.setitimer(signal.ITIMER_PROF, LIMIT)
        try:
            with contextlib.redirect_stdout(sys.stderr):
                found = answer(**json.loads(line))
        except Exception:  # a crash is an answer, too
            found = {'crash': traceback.format_exc()}
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0.0)
        print(json.dumps(found), flush=True)


if __name__ == '__main__':
    main()
