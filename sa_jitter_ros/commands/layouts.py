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
Command `layouts`: configuration of PlotJuggler, Foxglove and diagnostic_aggregator for a machine.

Topics, orders, channels and units are those of the machine file.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, fields
import json
from pathlib import Path
import re
import sys
import xml.etree.ElementTree as ET

from sa_jitter_ros.averaging.averager_parameters import shaft_parameters
from sa_jitter_ros.averaging.indicators import INDICATORS
from sa_jitter_ros.averaging.results import AMPLITUDE_FIELDS, AverageHeader
from sa_jitter_ros.commands.command_line import Parser, run_to_end, show
from sa_jitter_ros.commands.progress import Progress
from sa_jitter_ros.declaration import NODE as PREDICTOR, read_declaration
from sa_jitter_ros.nodes.messages import PREDICTION_FIELDS, PredictionMessage, ResidualMessage
from sa_jitter_ros.number_text import order_text
from sa_jitter_ros.offline.settings import AVERAGER, MachineFile
from sa_jitter_ros.parameter_file import named_parameters, read_parameters
from sa_jitter_ros.recordings.channel_units import channels_of

PLOTJUGGLER, FOXGLOVE = 'plotjuggler.xml', 'foxglove.json'
AGGREGATOR = 'diagnostic_aggregator.yaml'
_COLOURS = ('#1f77b4', '#d62728', '#2ca02c', '#ff7f0e', '#9467bd', '#8c564b', '#e377c2',
            '#7f7f7f', '#bcbd22', '#17becf')
_SPEED = 'Speed of the tach shaft'
_CHANNELS = 4  # of which amplitudes are plotted
_HEADER = len(fields(AverageHeader))
_ORDERS = next(item.default for item in shaft_parameters('') if item.name == '.orders')
# Path of a group of the aggregator, its nodes, and whether they run with `chain` alone.
_GROUPS = (
    ('Keyphasor', ('tach_detector',), False), ('Averages', (AVERAGER,), True),
    ('Prediction', (PREDICTOR, 'residual_analyser'), True),
    ('Machine', ('change_monitor',), False), ('View', ('live_view',), False),
    ('Test signals', ('machine_simulator', 'recording_player'), False))


@dataclass(frozen=True)
class Curve:
    """An element of an array, or with `element` None the number, on a topic."""

    topic: str
    element: int | None
    label: str


@dataclass(frozen=True)
class Shown:
    """What is shown: shafts with their orders, channels, units, and the nodes that run."""

    prefix: str  # namespace with a stroke at its end
    shafts: dict[str, tuple[float, ...]]
    predicted: dict[str, tuple[float, ...]]
    channels: dict[int, str]  # name, with the unit
    nodes: tuple[str, ...]

    @classmethod
    def read(cls, params: Path, namespace: str = '') -> 'Shown':
        """Read a machine file; raises SaJitterError."""
        values = MachineFile.read(params).averager
        models = (read_declaration(params).models
                  if named_parameters(params, (PREDICTOR,)) else {})
        channels = channels_of(read_parameters(params, AVERAGER))
        return cls(
            f'/{namespace}/'.replace('//', '/'),
            {shaft: tuple(values.get(f'{shaft}.orders') or _ORDERS)
             for shaft in values.get('shafts', ['shaft'])},
            {shaft: model.orders for shaft, model in models.items()},
            {int(name) if name.isdecimal() else place:
             (f'channel {name}' if name.isdecimal() else name)
             + (f' [{item["unit"]}]' if item['unit'] else '')
             for place, (name, item) in enumerate(channels.items())} or {0: 'channel 0'},
            tuple(node for _, nodes, always in _GROUPS for node in nodes
                  if always or named_parameters(params, (node,))))

    def plots(self, shaft: str) -> dict[str, list[Curve]]:
        """Return the curves of a shaft by the titles of their plots, that of the speed first."""
        orders, topic = self.shafts[shaft], f'{self.prefix}{shaft}/order_amplitude'

        def of_order(field: str, channel: int = 0) -> list[Curve]:
            place = AMPLITUDE_FIELDS.index(field)
            return [Curve(topic, _HEADER + len(AMPLITUDE_FIELDS) * (channel * len(orders) + k)
                          + place, f'order {order_text(order)}')
                    for k, order in enumerate(orders[:len(_COLOURS)])]

        found = {_SPEED: [Curve(f'{self.prefix}shaft_speed', None, 'Hz')]}
        for channel, name in [*self.channels.items()][:_CHANNELS]:
            for kind in ('raw', 'corrected'):
                found[f'Amplitude, {kind}, {name}'] = of_order(f'{kind}_amplitude', channel)
        found['Attenuation, measured'] = of_order('attenuation')
        topic_predicted = f'{shaft}/prediction' if len(self.predicted) > 1 else 'prediction'
        start = len(fields(PredictionMessage)) - 1
        found['Attenuation, predicted'] = [
            Curve(f'{self.prefix}{topic_predicted}', start + len(PREDICTION_FIELDS) * k
                  + PREDICTION_FIELDS.index('mean_attenuation'), f'order {order_text(order)}')
            for k, order in enumerate(self.predicted.get(shaft, ())[:len(_COLOURS)])]
        names = [item.name for item in fields(ResidualMessage)][1:]
        found['Residual'] = [
            Curve(f'{self.prefix}residual', names.index(name), label)
            for name, label in (('chi2_per_dof', 'chi2 per degree of freedom'), ('rms', 'RMS'))]
        found['Condition indicators'] = [
            Curve(f'{self.prefix}{shaft}/condition_indicator', _HEADER + INDICATORS.index(name),
                  name.replace('_', ' ')) for name in ('rms', 'kurtosis', 'crest_factor')]
        return {title: curves for title, curves in found.items() if curves}


def plotjuggler(machine: Shown) -> str:
    """Return the layout of PlotJuggler: for each shaft a tab of plots under the speed."""
    root = ET.Element('root')
    tabs = ET.SubElement(root, 'tabbed_widget', {
        'parent': 'main_window', 'name': 'Main Window'})
    for shaft in machine.shafts:
        tab = ET.SubElement(tabs, 'Tab', tab_name=shaft, containers='1')
        speed, *plots = machine.plots(shaft).items()
        rows = [[speed], *(plots[k:k + 2] for k in range(0, len(plots), 2))]
        outer = _splitter(ET.SubElement(tab, 'Container'), '-', len(rows))
        for row in rows:
            inner = _splitter(outer, '|', len(row))
            for title, curves in row:
                plot = ET.SubElement(
                    ET.SubElement(inner, 'DockArea', name=title), 'plot', style='Lines',
                    mode='TimeSeries', flip_x='false', flip_y='false')
                ET.SubElement(plot, 'limitY')
                for curve, colour in zip(curves, _COLOURS):
                    element = '' if curve.element is None else f'[{curve.element}]'
                    ET.SubElement(plot, 'curve', name=f'{curve.topic}/data{element}', color=colour)
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


def _splitter(parent: ET.Element, orientation: str, count: int) -> ET.Element:
    """Add a splitter with parts of equal size."""
    return ET.SubElement(parent, 'DockSplitter', orientation=orientation, count=str(count),
                         sizes=';'.join([f'{1 / count:.6f}'] * count))


def foxglove(machine: Shown) -> str:
    """Return the layout of Foxglove: plots on the left, waveforms and texts on the right."""
    panels: dict[str, dict[str, object]] = {}

    def add(kind: str, title: str, content: dict[str, object]) -> str:
        name = f'{kind}!{re.sub("[^a-z0-9]+", "_", title.lower()).strip("_")}'
        panels[name] = content
        return name

    def plot(title: str, paths: list[tuple[str, str]], x_axis: str = 'timestamp') -> str:
        return add('Plot', title, {
            'foxglovePanelTitle': title, 'xAxisVal': x_axis, 'isSynced': x_axis == 'timestamp',
            'showLegend': True, 'legendDisplay': 'floating', 'showXAxisLabels': True,
            'showYAxisLabels': True, 'paths': [
                {'value': value, 'label': label, 'enabled': True, 'timestampMethod': 'receiveTime'}
                for value, label in paths]})

    plots = {title if title == _SPEED or len(machine.shafts) == 1 else f'{shaft}: {title}': curves
             for shaft in machine.shafts for title, curves in machine.plots(shaft).items()}
    left = [plot(title, [
        (f'{curve.topic}.data' + ('' if curve.element is None else f'[{curve.element}]'),
         curve.label) for curve in curves]) for title, curves in plots.items()]
    texts = ['missing_effect.data', *['change.data'] * ('change_monitor' in machine.nodes),
             *(f'{shaft}/summary' for shaft in machine.shafts)]
    right = [
        plot('Waveform of one revolution', [
            (f'{machine.prefix}{shaft}/{kind}_average.data[{_HEADER}:]', f'{shaft}, {label}')
            for shaft in machine.shafts
            for kind, label in (('synchronous', 'raw'), ('corrected', 'corrected'))], 'index'),
        *(add('RawMessages', machine.prefix + text.removesuffix('.data'), {
            'topicPath': machine.prefix + text}) for text in texts),
        add('DiagnosticSummary', 'all', {
            'topicToRender': '/diagnostics', 'minLevel': 0, 'pinnedIds': [],
            'hardwareIdFilter': '', 'sortByLevel': True})]
    return json.dumps({
        'configById': panels, 'globalVariables': {}, 'userNodes': {},
        'playbackConfig': {'speed': 1},
        'layout': {'direction': 'row', 'first': _column(left), 'second': _column(right),
                   'splitPercentage': 60}}, indent=2) + '\n'


def _column(names: Sequence[str]) -> object:
    """Return panels above each other, of equal height."""
    if len(names) == 1:
        return names[0]
    return {'direction': 'column', 'first': names[0], 'second': _column(names[1:]),
            'splitPercentage': 100 / len(names)}


def aggregator(machine: Shown) -> str:
    """Return the configuration of diagnostic_aggregator: a group for each part that runs."""
    lines = [
        '# One light for the whole chain, and one for each of its parts. Start with',
        '#   ros2 run diagnostic_aggregator aggregator_node --ros-args --params-file '
        f'{AGGREGATOR}',
        '# A status is named as its node, with the namespace. A group none of whose nodes runs is '
        'stale:', '# leave out the groups that you do not start.', 'analyzers:',
        '  ros__parameters:', '    path: Synchronous averaging', '    pub_rate: 1.0']
    for path, nodes, _ in _GROUPS:
        running = [node for node in nodes if node in machine.nodes]
        names = [f'{machine.prefix[1:]}{node}' for node in running]
        if running:
            lines += [f'    {path.lower().replace(" ", "_")}:',
                      '      type: diagnostic_aggregator/GenericAnalyzer',
                      f'      path: {path}', f'      contains: [{", ".join(names)}]',
                      '      timeout: 5.0  # s without a status; nodes send one a second']
    return '\n'.join(lines) + '\n'


def make_parser() -> Parser:
    """Return the parser of the command line."""
    parser = Parser('layouts', __doc__)
    parser.add_argument('--params', type=Path, required=True, metavar='MACHINE.yaml',
                        help='parameter file of the machine')
    parser.add_argument('--namespace', default='', metavar='NAME', type=_namespace,
                        help='namespace of the nodes')
    parser.add_argument('--output', type=Path, required=True, metavar='DIR',
                        help=f'folder for {PLOTJUGGLER}, {FOXGLOVE} and {AGGREGATOR}')
    return parser


def _namespace(text: str) -> str:
    """Return a namespace without strokes at its ends; argparse says which option is wrong."""
    if not re.fullmatch(r'/?([a-zA-Z_]\w*(/[a-zA-Z_]\w*)*)?', text):
        raise argparse.ArgumentTypeError(f'{text!r}: give letters, digits and underscores')
    return text.strip('/')


def write(options: argparse.Namespace, progress: Progress) -> None:
    """Write the files; raises SaJitterError, OSError."""
    machine = Shown.read(options.params, options.namespace)
    options.output.mkdir(parents=True, exist_ok=True)
    for name, make in ((PLOTJUGGLER, plotjuggler), (FOXGLOVE, foxglove), (AGGREGATOR, aggregator)):
        (options.output / name).write_text(make(machine), 'utf-8')


def main(args: Sequence[str] | None = None) -> int:
    """Write the files; return the exit status."""
    return run_to_end(write, lambda options, _: show('layouts', f'written: {options.output}'),
                      make_parser().parse_args(args), Progress('layouts'))


if __name__ == '__main__':
    sys.exit(main())
