# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The pages and the reference build, as CONTRIBUTING.md says, without a warning."""

from importlib.util import find_spec
from pathlib import Path
import re
import subprocess
import sys

import pytest
import sa_jitter_ros
import sa_jitter_ros.errors

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.build
@pytest.mark.skipif(find_spec('sphinx') is None or find_spec('myst_parser') is None,
                    reason="Sphinx is not installed: pip install '.[docs]'")
def test_reference_builds_without_a_warning(tmp_path):
    command = [sys.executable, '-m', 'sphinx', '-q', '-W', '--keep-going', '-b', 'html',
               'docs', str(tmp_path)]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert 'sa_jitter_ros.pulses' in (tmp_path / 'reference.html').read_text(encoding='utf-8')


def test_names_of_the_glossary_exist():
    text = (ROOT / 'docs' / 'glossary.md').read_text(encoding='utf-8')
    names = set(re.findall(r'`(?:--)?(\w+)`', text))
    source = '\n'.join(path.read_text(encoding='utf-8')
                       for path in (ROOT / 'sa_jitter_ros').rglob('*.py'))
    assert len(names) > 80
    assert not names - set(re.findall(r'\w+', source))


def test_the_glossary_has_one_row_for_each_term():
    text = (ROOT / 'docs' / 'glossary.md').read_text(encoding='utf-8')
    rows = re.findall(r'(?m)^\| ([^|]+) \|(?:[^|\n]*\|){2}$', text)
    terms = [term for term in rows if term != 'term']
    assert len(terms) == len(set(terms)) > 50


def test_the_reference_of_the_library_has_every_public_name():
    text = (ROOT / 'docs' / 'library.rst').read_text(encoding='utf-8')
    documented = re.findall(r'(?m)^\.\. auto(?:function|class):: (\w+)$', text)
    errors = {name for name in sa_jitter_ros.__all__ if hasattr(sa_jitter_ros.errors, name)}
    assert '.. automodule:: sa_jitter_ros.errors' in text
    assert sorted(documented) == sorted(set(sa_jitter_ros.__all__) - errors)
    assert set(re.findall(r'(?m)^   (\w+)$', text)) <= set(documented)


def test_the_reference_has_every_module():
    text = (ROOT / 'docs' / 'reference.rst').read_text(encoding='utf-8')
    modules = {path.stem for path in (ROOT / 'sa_jitter_ros').iterdir()
               if not path.name.startswith('_') and (path.suffix == '.py' or path.is_dir())}
    listed = re.findall(r'(?m)^   sa_jitter_ros\.(\w+)$', text)
    assert sorted(listed) == sorted(modules - {'errors'})  # which are on the page of the library
