# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.


"""The page of a machine: what the files say, in HTML that prints on any paper."""

from html import unescape
from html.parser import HTMLParser
import re

import numpy as np
import pytest
from sa_jitter_ros.number_text import measured_text
from sa_jitter_ros.offline.average_recording import average_file, AverageJob
from sa_jitter_ros.offline.machine_page import write_page
from sa_jitter_ros.offline.settings import MachineFile
from sa_jitter_ros.simulation import AdditiveNoise, DeclaredJitter, Gearbox, mesh

CLOCK, RATE, SPEED, SECONDS = 3000.0, 8000.0, 16.6, 5.0
MACHINE = f"""/**:
  ros__parameters:
    hardware_id: press <2>
    machine:
      tach_shaft: output
      gears: {{g: {{shaft: input, teeth: 19, mate_shaft: output, mate_teeth: 38}}}}
      limits:
        mesh: {{part: mesh input-output 1x, shaft: input, channel: near, warn: 0.5, alarm: 5.0}}
      bearings: {{b: {{shaft: input, cage: 0.4, ball: 2.3, inner: 5.4, outer: 3.6}}}}
/**/synchronous_averager:
  ros__parameters:
    shafts: [input]
    trigger_cycles: 20
    keyphasor_rate: {CLOCK}
    correct_jitter: true
"""


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """Return the folder of a recording that was averaged without figures."""
    place = tmp_path_factory.mktemp('page')
    machine = Gearbox(mesh('input', 19, harmonics=(1.0, 0.5)), RATE, shafts={'input': 2.0},
                      speed=((0.0, SPEED),), seed=1, effects=(
                          DeclaredJitter('uniform', 1 / CLOCK / 12**0.5), AdditiveNoise(0.1)))
    samples = machine.vibration(0, round(RATE * SECONDS))[0]
    np.savez(place / 'rig.npz', vibration=samples * np.array([[0.1], [1.0], [0.6], [0.3]]),
             sample_rate=RATE, pulse_times=machine.pulses(0.0, SECONDS).times, units=4 * ['g'],
             channel_names=['far', 'near', 'side <a>', 'top'])
    (place / 'machine.yaml').write_text(MACHINE)
    row = average_file(AverageJob(
        'rig', str(place / 'rig.npz'), str(place / 'out'),
        machine=MachineFile.read(place / 'machine.yaml'), figures=False))
    assert row.averages == 4
    write_page(place / 'out')
    return place / 'out'


class Tables(HTMLParser):
    """The cells of a page, row by row."""

    def __init__(self, text):
        super().__init__()
        self.rows, self.open = [], []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        if tag not in ('meta', 'br', 'img'):
            self.open.append(tag)
        if tag == 'tr':
            self.rows.append([])
        elif tag in ('td', 'th'):
            self.rows[-1].append('')

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] in ('td', 'th'):
            self.rows[-1][-1] += data.replace('\u00a0', ' ')


def test_tables_hold_the_last_average_of_the_strongest_channels(folder):
    text = (folder / 'page.html').read_text()
    rows = {row[0]: row[1:] for row in Tables(text).rows}
    assert '<h1>press &lt;2&gt;</h1>' in text
    assert rows['order'] == ['near [g]', 'side <a> [g]', 'top [g]', 'attenuation']
    arrays = np.load(folder / 'averages.npz')
    fields = arrays['input_order_amplitude_fields'].tolist()
    orders = arrays['input_order_amplitude'][-1, 0, :, 0].tolist()
    table = dict(zip(fields, arrays['input_order_amplitude'][-1, 1, orders.index(19.0)]))
    shown = rows['mesh input-output 1x (19)']
    assert shown[0] == measured_text(table['corrected_amplitude'],
                                     1.96 * table['corrected_standard_error'])
    assert float(shown[0].split()[0]) == pytest.approx(1.0, abs=0.03)
    assert shown[3] == '{} %'.format(measured_text(
        100.0 * table['attenuation'], 196.0 * table['attenuation_standard_error']))
    names = arrays['input_condition_indicator_names'].tolist()
    rms = arrays['input_condition_indicator'][-1, 1, names.index('rms')]
    assert rows['rms'][0].startswith(f'{rms:.2g}'[:4])
    assert rows['rms'][0].endswith(' g')
    assert len(rows['bearing b outer (3.6)']) == 3
    assert re.search(
        '<p class="verdict unexplained">Limits are passed:<br>mesh input-output 1x of input, '
        'channel 1: [^ ]* above 0.5 .warn., since average 0</p>', text)
    assert rows['mesh'] == ['mesh input-output 1x', 'input', 'near', '0.5', '5']
    assert '<p>Note: mesh' not in text
    jitter = 1e6 / CLOCK / 12**0.5
    found = re.fullmatch('(.*) µs', rows['pulse errors, RMS'][0])
    assert float(found[1]) == pytest.approx(jitter, rel=0.25)
    assert rows['smallest attenuation, input'][0].endswith(
        ' % are left of mesh input-output 2x (38)')
    assert rows['averaged and dropped'][0].startswith('82 trigger cycles averaged; 0 cycles')


def test_a_page_prints_on_any_paper(folder):
    """No width is fixed, no other file is needed, and nothing that belongs together is cut."""
    text = unescape((folder / 'page.html').read_text())
    style = re.search('<style>(.*)</style>', text, re.DOTALL)[1]
    assert '@page { margin' in style
    assert 'size:' not in style.replace('font-size:', '')
    assert not re.findall(r'(?<!max-)(?<!min-)width: *[\d.]+(px|mm|cm|in|pt)', style)
    assert 'break-inside: avoid' in style
    assert '<thead>' in text  # is repeated on the next sheet
    assert not re.findall(r'(?:src|href)="(?!data:)', text)


def test_recordings_without_correction_bearings_and_machine_have_a_page(folder, tmp_path):
    row = average_file(AverageJob(
        'plain', str(folder.parent / 'rig.npz'), str(tmp_path), figures=False,
        machine=MachineFile.read(None, ['trigger_cycles:=40', 'correct_jitter:=false'])))
    assert row.averages == 2
    write_page(tmp_path)
    rows = {row[0]: row[1:] for row in Tables((tmp_path / 'page.html').read_text()).rows}
    assert '<h1>plain</h1>' in (tmp_path / 'page.html').read_text()
    assert {'order', 'rms', 'averaged and dropped'} <= rows.keys()
    assert not [name for name in rows if name.startswith(('pulse errors', 'bearing'))]
