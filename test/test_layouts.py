# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The layouts for PlotJuggler and Foxglove, and the configuration of the aggregator."""

from collections.abc import Iterator
from importlib import import_module
import json
from pathlib import Path
import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from sa_jitter_ros.averaging.results import AMPLITUDE_FIELDS, AverageHeader, AverageMessage
from sa_jitter_ros.commands import layouts
from sa_jitter_ros.nodes.messages import encode_average
import yaml

ROOT = Path(__file__).resolve().parents[1]
CONFIG = ROOT / 'config'
SHIPPED = CONFIG / 'machine.yaml'
NODES = ('synchronous_averager', 'jitter_predictor', 'residual_analyser', 'change_monitor')
TWO_SHAFTS = """
/**:
  ros__parameters:
    machine:
      channels:
        case: {unit: g, sensitivity: 0.1}
        foot: {unit: g}
/**/synchronous_averager:
  ros__parameters:
    shafts: [wheel, pinion]
    wheel.orders: [61.0, 122.0]
    pinion.orders: [19.0, 38.5]
/**/jitter_predictor:
  ros__parameters:
    shafts: [wheel, pinion]
    wheel.orders: [61.0]
    pinion.orders: [19.0, 38.5]
/**/change_monitor:
  ros__parameters:
    shafts: [wheel, pinion]
"""


@pytest.fixture(params=['shipped', 'two_shafts'])
def written(request, tmp_path):
    """Return a machine file, a folder with its layouts, and the namespace."""
    params, namespace = SHIPPED, ''
    if request.param == 'two_shafts':
        params, namespace = tmp_path / 'two.yaml', '/rig/a'
        params.write_text(TWO_SHAFTS)
    assert layouts.main(['--params', str(params), '--output', str(tmp_path / 'out'),
                         '--namespace', namespace]) == 0
    return params, tmp_path / 'out', namespace


@pytest.fixture
def topics(written, ros_graph):
    """Return the topics that the nodes publish with this machine file."""
    params, _, namespace = written
    found = set()
    for name in NODES:
        module = import_module(f'sa_jitter_ros.nodes.{name}')
        node = ros_graph.add(
            getattr(module, name.title().replace('_', '')), namespace=namespace or None,
            cli_args=['--ros-args', '--params-file', str(params)])
        found |= {publisher.topic_name for publisher in node.publishers}
    return found


def curves_of(folder):
    """Return the names of the curves of PlotJuggler by the titles of their plots."""
    root = ET.parse(folder / layouts.PLOTJUGGLER).getroot()
    for item in root.iter('DockSplitter'):
        assert int(item.attrib['count']) == len(item) == len(item.attrib['sizes'].split(';'))
    return {(tab.attrib['tab_name'], area.attrib['name']):
            [curve.attrib['name'] for curve in area.iter('curve')]
            for tab in root.iter('Tab') for area in tab.iter('DockArea')}


def leaves(layout: dict[str, object] | str) -> Iterator[str]:
    """Iterate over the panels of a layout."""
    if isinstance(layout, str):
        yield layout
    else:
        yield from leaves(layout['first'])
        yield from leaves(layout['second'])


def test_shipped_files_are_those_of_the_shipped_machine(tmp_path):
    assert layouts.main(['--params', str(SHIPPED), '--output', str(tmp_path)]) == 0
    for name in (layouts.PLOTJUGGLER, layouts.FOXGLOVE, layouts.AGGREGATOR):
        assert (CONFIG / name).read_text('utf-8') == (tmp_path / name).read_text('utf-8'), (
            f'run: ros2 run sa_jitter_ros layouts --params {SHIPPED} --output {CONFIG}')


def test_both_show_published_topics(written, topics):
    _, folder, namespace = written
    plotted = {re.sub(r'/data(\[\d+\])?$', '', name)
               for names in curves_of(folder).values() for name in names}
    assert plotted <= topics
    layout = json.loads((folder / layouts.FOXGLOVE).read_text('utf-8'))
    panels = layout['configById']
    paths = [path['value'] for panel in panels.values() for path in panel.get('paths', ())]
    shown = {path.partition('.')[0] for path in paths} | {
        panel[key].partition('.')[0] for panel in panels.values()
        for key in ('topicPath', 'topicToRender') if key in panel}
    assert plotted | {f'{namespace}/change', '/diagnostics'} <= shown <= topics
    assert sorted(leaves(layout['layout'])) == sorted(panels)
    for kind in ('synchronous_average', 'summary', 'order_amplitude', 'prediction'):
        assert any(topic.endswith(f'/{kind}') for topic in shown)


def test_elements_are_those_of_the_named_channel_order_and_field(tmp_path):
    (tmp_path / 'two.yaml').write_text(TWO_SHAFTS)
    assert layouts.main(['--params', str(tmp_path / 'two.yaml'),
                         '--output', str(tmp_path)]) == 0
    curves = curves_of(tmp_path)
    values = np.arange(2.0 * 2 * len(AMPLITUDE_FIELDS)).reshape(2, 2, -1)
    message = encode_average('order_amplitude', AverageMessage(
        AverageHeader(0.0, 1.0, 0, 10, 10, 25.0), values, AMPLITUDE_FIELDS))
    for title, channel, field in (('Amplitude, raw, case [g]', 0, 'raw_amplitude'),
                                  ('Amplitude, corrected, foot [g]', 1, 'corrected_amplitude'),
                                  ('Attenuation, measured', 0, 'attenuation')):
        places = [int(re.search(r'\[(\d+)\]', name)[1]) for name in curves['pinion', title]]
        np.testing.assert_array_equal(
            np.array(message.data)[places], values[channel, :, AMPLITUDE_FIELDS.index(field)])
    panels = json.loads((tmp_path / layouts.FOXGLOVE).read_text('utf-8'))['configById']
    paths = panels['Plot!pinion_amplitude_raw_case_g']['paths']
    assert [path['label'] for path in paths] == ['order 19', 'order 38.5']


def test_aggregator_takes_the_status_of_every_node_once():
    analyzers = yaml.safe_load((CONFIG / 'diagnostic_aggregator.yaml').read_text())
    groups = [item for item in analyzers['analyzers']['ros__parameters'].values()
              if isinstance(item, dict)]
    assert all(item['type'] == 'diagnostic_aggregator/GenericAnalyzer' for item in groups)
    found = re.search(r'(?s)\nNODES = \((.*?)\)', (ROOT / 'setup.py').read_text())
    names = re.findall(r"'(\w+)'", found[1])
    for name in names:
        assert sum(part in f'rig/{name}' for item in groups for part in item['contains']) == 1
    assert {part for item in groups for part in item['contains']} == set(names)


def test_unusable_input_is_one_line(tmp_path, capsys):
    assert layouts.main(['--params', 'none.yaml', '--output', str(tmp_path)]) == 2
    line, = capsys.readouterr().err.splitlines()
    assert 'none.yaml: No such file or directory' in line
    with pytest.raises(SystemExit):
        layouts.main(['--params', str(SHIPPED), '--namespace', 'a b', '--output', str(tmp_path)])
    line, = capsys.readouterr().err.splitlines()
    assert "--namespace: 'a b': give letters" in line
