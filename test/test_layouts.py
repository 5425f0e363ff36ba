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
The layouts for PlotJuggler and Foxglove, and the configuration of the diagnostic aggregator.

The layouts name elements of arrays, whose places follow from the messages: `python
test/test_layouts.py` writes them into config/.
"""

from collections.abc import Iterator
from dataclasses import fields
from importlib import import_module
import json
from pathlib import Path
import re
import xml.etree.ElementTree as ET

import pytest
from rclpy.context import Context
from sa_jitter_ros.averaging.indicators import INDICATORS
from sa_jitter_ros.nodes.messages import (
    AMPLITUDE_FIELDS, AverageHeader, PREDICTION_FIELDS, PredictionMessage, RESIDUAL_FIELDS,
    ResidualMessage)
import yaml

ROOT = Path(__file__).resolve().parents[1]
CONFIG = ROOT / 'config'
PLOTJUGGLER = CONFIG / 'plotjuggler.xml'
FOXGLOVE = CONFIG / 'foxglove.json'
ORDERS = 3  # of the averager's default
COLOURS = ('#1f77b4', '#d62728', '#2ca02c')
# Topic to the number of its header elements and the names of its last dimension.
TABLES = {
    '/shaft/order_amplitude': (len(fields(AverageHeader)), AMPLITUDE_FIELDS),
    '/shaft/condition_indicator': (len(fields(AverageHeader)), INDICATORS),
    '/prediction': (len(fields(PredictionMessage)) - 1, PREDICTION_FIELDS),
    '/residual': (len(fields(ResidualMessage)) - 1, RESIDUAL_FIELDS)}
SPEED = '/shaft_speed'
TEXTS = '/missing_effect', '/change'  # JSON
WAVEFORMS = ('/shaft/synchronous_average', '/shaft/corrected_average')
# Title, and per curve the topic, the field and the row (order of channel 0, or channel).
PLOTS = {
    'Amplitude, raw': [('/shaft/order_amplitude', 'raw_amplitude', k) for k in range(ORDERS)],
    'Amplitude, corrected': [
        ('/shaft/order_amplitude', 'corrected_amplitude', k) for k in range(ORDERS)],
    'Attenuation, measured': [('/shaft/order_amplitude', 'attenuation', k) for k in range(ORDERS)],
    'Attenuation, predicted': [('/prediction', 'mean_attenuation', k) for k in range(ORDERS)],
    'Residual over its standard error': [('/residual', 'z', k) for k in range(ORDERS)],
    'Condition indicators': [
        ('/shaft/condition_indicator', name, 0) for name in ('rms', 'kurtosis', 'crest_factor')]}


def element(topic: str, field: str, row: int) -> int:
    """Return the index in `data` of a field of a row."""
    header, names = TABLES[topic]
    return header + len(names) * row + names.index(field)


def label(field: str, row: int) -> str:
    """Return what a legend calls a curve."""
    return field.replace('_', ' ') if field in INDICATORS else f'order {row + 1}'


def plotjuggler() -> str:
    """Return the layout of PlotJuggler: a tab of six plots under the speed."""
    root = ET.Element('root')
    tabs = ET.SubElement(root, 'tabbed_widget', parent='main_window', name='Main Window')
    tab = ET.SubElement(tabs, 'Tab', tab_name='synchronous average', containers='1')
    rows: list[list[tuple[str, list[str]]]] = [[('Speed of the tach shaft', [f'{SPEED}/data'])]]
    curves = [(title, [f'{topic}/data[{element(topic, field, row)}]'
                       for topic, field, row in items]) for title, items in PLOTS.items()]
    rows += [curves[i:i + 2] for i in range(0, len(curves), 2)]
    outer = splitter(ET.SubElement(tab, 'Container'), '-', len(rows))
    for items in rows:
        inner = splitter(outer, '|', len(items))
        for title, names in items:
            plot = ET.SubElement(ET.SubElement(inner, 'DockArea', name=title), 'plot',
                                 style='Lines', mode='TimeSeries', flip_x='false', flip_y='false')
            ET.SubElement(plot, 'limitY')
            for name, colour in zip(names, COLOURS):
                ET.SubElement(plot, 'curve', name=name, color=colour)
    ET.SubElement(tabs, 'currentTabIndex', index='0')
    ET.SubElement(root, 'use_relative_time_offset', enabled='1')
    plugin = ET.SubElement(ET.SubElement(root, 'Plugins'), 'plugin', ID='ROS2 Topic Subscriber')
    for name, value in (('use_header_stamp', 'false'), ('discard_large_arrays', 'true'),
                        ('max_array_size', '10000')):
        ET.SubElement(plugin, name, value=value)
    ET.SubElement(root, 'previouslyLoaded_Datafiles')
    ET.SubElement(root, 'previouslyLoaded_Streamer', name='ROS2 Topic Subscriber')
    ET.indent(root)
    return "<?xml version='1.0' encoding='UTF-8'?>\n" + ET.tostring(root, 'unicode') + '\n'


def splitter(parent: ET.Element, orientation: str, count: int) -> ET.Element:
    """Add a splitter with parts of equal size."""
    return ET.SubElement(parent, 'DockSplitter', orientation=orientation, count=str(count),
                         sizes=';'.join([f'{1 / count:.6f}'] * count))


def foxglove() -> str:
    """Return the layout of Foxglove: plots on the left, waveforms and diagnostics on the right."""
    panels: dict[str, dict[str, object]] = {}

    def plot(title: str, paths: list[tuple[str, str]], x_axis: str = 'timestamp') -> str:
        name = f'Plot!{re.sub("[^a-z]+", "_", title.lower())}'
        panels[name] = {
            'foxglovePanelTitle': title, 'xAxisVal': x_axis, 'isSynced': x_axis == 'timestamp',
            'showLegend': True, 'legendDisplay': 'floating', 'showXAxisLabels': True,
            'showYAxisLabels': True, 'paths': [
                {'value': value, 'label': text, 'enabled': True, 'timestampMethod': 'receiveTime'}
                for value, text in paths]}
        return name

    left = [plot('Speed of the tach shaft', [(f'{SPEED}.data', 'Hz')])] + [
        plot(title, [(f'{topic}.data[{element(topic, field, row)}]', label(field, row))
                     for topic, field, row in items]) for title, items in PLOTS.items()]
    start = len(fields(AverageHeader))
    right = [plot('Waveform of one revolution', [
        (f'{topic}.data[{start}:]', text)
        for topic, text in zip(WAVEFORMS, ('raw', 'corrected'))], 'index')]
    texts = []
    for topic in TEXTS:
        texts.append(f'RawMessages!{topic[1:]}')
        panels[texts[-1]] = {'topicPath': f'{topic}.data'}
    panels['DiagnosticSummary!all'] = {
        'topicToRender': '/diagnostics', 'minLevel': 0, 'pinnedIds': [], 'hardwareIdFilter': '',
        'sortByLevel': True}
    right += [*texts, 'DiagnosticSummary!all']
    return json.dumps({
        'configById': panels, 'globalVariables': {}, 'userNodes': {},
        'playbackConfig': {'speed': 1},
        'layout': {'direction': 'row', 'first': column(left), 'second': column(right),
                   'splitPercentage': 60}}, indent=2) + '\n'


def column(names: list[str]) -> object:
    """Return panels above each other, of equal height."""
    if len(names) == 1:
        return names[0]
    return {'direction': 'column', 'first': names[0], 'second': column(names[1:]),
            'splitPercentage': 100 / len(names)}


@pytest.mark.parametrize(('path', 'make'), [(PLOTJUGGLER, plotjuggler), (FOXGLOVE, foxglove)])
def test_layout_names_the_elements_that_the_messages_have(path, make):
    assert path.read_text('utf-8') == make(), 'run: python test/test_layouts.py'


@pytest.fixture(scope='module')
def topics():
    """Return the topics that the nodes publish with their defaults."""
    found = set()
    context = Context()
    context.init(args=[])
    try:
        for name in ('synchronous_averager', 'jitter_predictor', 'residual_analyser',
                     'change_monitor'):
            node = node_class(name)(context=context)
            found |= {publisher.topic_name for publisher in node.publishers}
            assert name != 'synchronous_averager' or len(
                node.get_parameter('shaft.orders').value) == ORDERS
            node.destroy_node()
    finally:
        context.try_shutdown()
    return found


def node_class(name: str) -> type:
    """Return the class of a node of this package."""
    module = import_module(f'sa_jitter_ros.nodes.{name}')
    return getattr(module, ''.join(word.capitalize() for word in name.split('_')))


def test_plotjuggler_plots_published_topics(topics):
    root = ET.parse(PLOTJUGGLER).getroot()
    names = [curve.attrib['name'] for curve in root.iter('curve')]
    assert {re.sub(r'/data(\[\d+\])?$', '', name) for name in names} == {SPEED, *TABLES} <= topics
    for item in root.iter('DockSplitter'):
        assert int(item.attrib['count']) == len(item) == len(item.attrib['sizes'].split(';'))


def test_foxglove_shows_published_topics_in_every_panel(topics):
    layout = json.loads(FOXGLOVE.read_text('utf-8'))
    panels = layout['configById']
    paths = [path['value'] for panel in panels.values() for path in panel.get('paths', ())]
    shown = {path.partition('.')[0] for path in paths} | {
        panel[key].partition('.')[0] for panel in panels.values()
        for key in ('topicPath', 'topicToRender') if key in panel}
    assert shown == {SPEED, '/diagnostics', *TEXTS, *WAVEFORMS, *TABLES} <= topics
    assert sorted(leaves(layout['layout'])) == sorted(panels)


def leaves(layout: dict[str, object] | str) -> Iterator[str]:
    """Iterate over the panels of a layout."""
    if isinstance(layout, str):
        yield layout
    else:
        yield from leaves(layout['first'])
        yield from leaves(layout['second'])


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


if __name__ == '__main__':
    PLOTJUGGLER.write_text(plotjuggler(), 'utf-8')
    FOXGLOVE.write_text(foxglove(), 'utf-8')
