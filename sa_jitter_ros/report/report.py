# Copyright 2026 sa_jitter_ros contributors
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The content of `report.json`, its summary as text, and the section of a machine file."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, MISSING
import math
from types import MappingProxyType
from typing import Any

import numpy as np
from sa_jitter_ros.effects import parameter_ranges
from sa_jitter_ros.effects.additive_noise import AdditiveNoise
from sa_jitter_ros.effects.clock_skew import ClockSkew
from sa_jitter_ros.effects.effect import departs, Finding, same
from sa_jitter_ros.effects.jitter_scale import JitterScale
from sa_jitter_ros.effects.keyphasor_quantisation import KeyphasorQuantisation
from sa_jitter_ros.inference.candidates import Candidate
from sa_jitter_ros.inference.residual import Residual
from sa_jitter_ros.inference.trace_result import Trace
from sa_jitter_ros.json_values import json_values
from sa_jitter_ros.number_text import measured_text
from sa_jitter_ros.parameter_file import section_text
from sa_jitter_ros.prediction.model import DeclaredModel
from sa_jitter_ros.version import __version__

Json = Any

ONLY_SHAFT = 'shaft'  # the name of a shaft that was given none
_NODE = 'jitter_predictor'
_OF_SHAFT = ('ratio', 'orders')
_DIGITS, _DIGITS_OF_RATIO = 6, 10


def report(trace: Trace, *, recordings: Sequence[str] = (), shaft: str = ONLY_SHAFT,
           models: Mapping[str, DeclaredModel] = MappingProxyType({}), unit: str = '',
           created: str = '', faults: Sequence[str] = (), ratio_is_stated: bool = False
           ) -> Mapping[str, Json]:
    """
    Return the content of `report.json`; undefined numbers are None.

    `shaft` is the name of the shaft, `models` are those of all shafts that are declared beside it;
    `unit` is that of the vibration, `created` the time of the analysis; `faults` of the recordings
    are the first remarks. `ratio_is_stated` in a recording: the parameter file keeps it.
    """
    observation = trace.observation
    orders = observation.orders
    lines = [{
        'channel': observation.channel_names[c], 'order': orders[g],
        'name': observation.name_of(orders[g]), 'level': trace.level[i],
        'observed': trace.attenuation[list(trace.held_out), i].mean(),
        'predicted_as_declared': (trace.attenuation[list(trace.held_out), i].mean()
                                  - trace.as_declared.mean[i]),
        'predicted_before': trace.prediction_before.attenuation[list(trace.held_out), i].mean(),
        'predicted_after': trace.prediction_after.attenuation[list(trace.held_out), i].mean(),
        'standard_error': trace.after.standard_error[i],
    } for i, (c, g) in enumerate(zip(trace.lines.channel, trace.lines.order))]
    content: Mapping[str, Json] = json_values({
        'declared': {**asdict(observation.model), 'trigger_speed': observation.declared_speed,
                     'effects': {effect.name: effect.values for effect in trace.declared}},
        'measured_speed': observation.model.trigger_speed,
        'recordings': list(recordings),
        'shaft': shaft,
        'unit': unit,
        'created': created,
        'version': __version__,
        'parameter_file': new_section(trace, models or {shaft: observation.model},
                                      ratio_is_stated=ratio_is_stated),
        'remarks': [*faults, *observation.pulses.remarks, *_not_compared(trace)],
        'acquisitions': {'fit': len(trace.fit), 'held_out': len(trace.held_out)},
        'orders': orders,
        'order_names': [observation.name_of(order) for order in orders],
        'against': 'reference keyphasor' if observation.against_reference else 'vibration',
        'missing_effects': [_effect(finding) for finding in trace.findings
                            if finding.name not in {item.name for item in trace.declared}],
        'present': [{**_effect(finding), 'largest_change': finding.largest_change}
                    for finding in trace.present],
        'limits': [{'name': item.name, 'parameter': item.parameter, 'upper_95': item.upper,
                    'lower_95': item.lower, 'unit': item.unit} for item in trace.limits],
        'undecided': list(trace.undecided),
        'probabilities': trace.probabilities,
        'declared_changes': _changes(trace),
        'candidates': [_candidate(item) for item in trace.candidates],
        'error_before': errors(trace.before),
        'error_after': errors(trace.after),
        'error_as_declared': errors(trace.as_declared),
        'gain': asdict(trace.gain),
        'unsteadiness': trace.unsteadiness,
        'verdict': trace.verdict,
        'remains': trace.remains,
        'clock_steps': [{'time': item.time, 'step': item.step,
                         'standard_error': item.standard_error, 'period': item.period}
                        for item in observation.clock_steps],
        'unsteady_lines': [{**asdict(item), 'name': observation.name_of(item.order)}
                           for item in trace.unsteady],
        'not_testable': [{'name': name, 'reason': reason}
                         for name, reason in trace.not_testable.items()],
        'lines': lines,
    })
    return content


def errors(item: Residual) -> Mapping[str, Json]:
    """Return the summary of a residual."""
    return {
        'rms': item.rms, 'chi2_per_dof': item.chi2_per_dof, 'ks': item.ks,
        'cramer_von_mises': item.cramer_von_mises, 'coverage_95': item.coverage,
        'mean': item.mean.mean() if item.mean.size else None,
        'rms_standard_error': item.rms_standard_error,
        'rms_parameter_error': item.rms_parameter_error, 'p_value': item.p_value}


def summary(content: Mapping[str, Json]) -> str:
    """Return the report in a few lines of text."""
    before, after = content['error_before'], content['error_after']
    text = [f'verdict: {content["verdict"]}', *content['remarks']]
    for effect in content['missing_effects']:
        text.append(f'missing effect: {effect["name"]} '
                    f'({parameters_text(effect, content["unit"])})')
        text.append(f'  {effect["evidence"]}')
        if effect['indistinguishable_from']:
            text.append(f'  these data do not distinguish it from: '
                        f'{", ".join(effect["indistinguishable_from"])}')
    for item in other_numbers(content):
        text.append(f'{item["name"]}: {change_text(item, content["unit"])}')
    text += [f'measured {item["name"]}: {change_text(item, content["unit"])}'
             for item in refinements(content)]
    if content['lines']:
        text.append(f'held-out error (RMS of observed minus predicted attenuation): '
                    f'{before["rms"]:.4f} before, {after["rms"]:.4f} after')
        text.append(f'chi2 per degree of freedom: {before["chi2_per_dof"]:.3g} before, '
                    f'{after["chi2_per_dof"]:.3g} after')
    if content['remains']:
        text.append(content['remains'])
    if content['unsteadiness']:
        text.append('unexplained scatter of the amplitudes (unsteadiness): '
                    f'{content["unsteadiness"]:.2%}; chi2 takes it into account')
    return '\n'.join(text)


def other_numbers(content: Mapping[str, Json]) -> Sequence[Mapping[str, Json]]:
    """Return the changes of declared numbers that no missing effect stands for."""
    declared = content['declared']['effects']
    return [item for item in content['declared_changes'] if item['declared'] is not None and (
        item['name'] in declared or (
            item['parameter'] == 'noise_std' and item['value'] < item['declared']))]


def refinements(content: Mapping[str, Json]) -> Sequence[Mapping[str, Json]]:
    """Return the numbers that were not declared and that the recording shows."""
    return [item for item in content['declared_changes'] if item['declared'] is None]


def change_text(item: Mapping[str, Json], unit: str) -> str:
    """Return a number of a declared effect as it is and as it was declared."""
    unit = parameter_unit(item['name'], item['parameter'], item['unit'], unit)
    before = ('not declared' if item['declared'] is None else
              f'declared as {measured_text(item["declared"], None, unit)}')
    value = measured_text(item['value'], item['standard_error'], unit)
    return f'{item["parameter"]} = {value}, {before}'


def _not_compared(trace: Trace) -> Sequence[str]:
    """Return a remark on the declared orders that have no line to compare, one if none has."""
    if trace.not_compared:
        return [trace.not_compared]
    orders = trace.observation.orders
    without = np.setdiff1d(np.arange(orders.size), trace.lines.order)
    names = ', '.join(trace.observation.words(order) for order in orders[without])
    return [f'declared, but not compared: {names}; the phase is on no channel as constant from '
            'cycle to cycle as that of the other lines'] * bool(names)


def _changes(trace: Trace) -> list[Mapping[str, Json]]:
    """Return the declared numbers that are others, and what they are."""
    model = trace.observation.model
    found: list[tuple[Json, ...]] = []
    jitter = math.sqrt(model.distribution.variance)
    declared = {effect.name: effect for effect in trace.declared}
    cycles = len(trace.observation.acquisitions) * model.trigger_cycles
    small = [item for item in trace.present if item.effect is not None and (
        departs(item.effect, item.standard_errors, declared[item.name], cycles)
        if item.name in declared
        else isinstance(item.effect, AdditiveNoise) and model.noise > 0.0)]
    for item in (*trace.findings, *small):
        effect = item.effect
        if effect is None:
            continue
        error = item.standard_errors
        if isinstance(effect, JitterScale):
            found.append(('jitter', 'jitter_std', jitter, jitter * effect.scale,
                          jitter * error['scale'], 's'))
        elif isinstance(effect, ClockSkew) and effect.by_angle == 1.0:
            found.append(('ratio', 'ratio', model.ratio, effect.ratio(model),
                          model.ratio * error['skew'], '1'))
        elif item.name in declared:
            for name, limits in parameter_ranges(type(effect)).items():
                before, value = declared[item.name].values[name], effect.values[name]
                if error.get(name) is not None or not same(before, value):
                    found.append((item.name, name, before, value, error.get(name), limits.unit))
        elif isinstance(effect, AdditiveNoise):
            total = math.hypot(model.noise, effect.std)
            found.append(('noise', 'noise_std', model.noise_std, total,
                          effect.std / total * error['std'], '1'))
    if trace.clock.same_as(model.keyphasor_rate) and not trace.refinements and (
            KeyphasorQuantisation.name not in {name for name, *_ in found} | declared.keys()):
        found.append((KeyphasorQuantisation.name, 'clock_rate', None, trace.clock.rate,
                      trace.clock.standard_error, 'Hz'))
    for item in trace.refinements:
        assert item.effect is not None
        found += [(item.name, name, None, item.effect.values[name],
                   item.standard_errors.get(name), limits.unit)
                  for name, limits in parameter_ranges(type(item.effect)).items()]
    if trace.noise is not None:
        found.append(('noise', 'noise_std', model.noise_std, *trace.noise, '1'))
    keys = 'name', 'parameter', 'declared', 'value', 'standard_error', 'unit'
    return [dict(zip(keys, row)) for row in found]


def _effect(finding: Finding) -> Mapping[str, Json]:
    assert finding.effect is not None
    ranges = parameter_ranges(type(finding.effect))
    evidence = finding.evidence
    if finding.indistinguishable_from:
        others = ', '.join(finding.indistinguishable_from)
        evidence += f'; {finding.deciding_measurement} would distinguish it from {others}'
    return {
        'name': finding.name,
        'parameters': {name: {'value': value,
                              'standard_error': finding.standard_errors.get(name),
                              'unit': ranges[name].unit}
                       for name, value in finding.effect.values.items()},
        'evidence': evidence, 'p_value': None,
        'deciding_measurement': finding.deciding_measurement,
        'indistinguishable_from': list(finding.indistinguishable_from)}


def _candidate(item: Candidate) -> Mapping[str, Json]:
    return {'name': item.name, 'round': item.stage, 'held_out_score': item.held_out_score,
            'p_value': None, 'rejected_because': item.rejected_because,
            'added': not item.rejected_because}


def parameters_text(effect: Mapping[str, Json], unit: str = '') -> str:
    """
    Return the parameters of an effect of the report, with standard errors and units.

    `unit` is that of the vibration, which noise is in.
    """
    return ', '.join(
        f'{name} = ' + measured_text(item['value'], item['standard_error'],
                                     parameter_unit(effect['name'], name, item['unit'], unit))
        for name, item in effect['parameters'].items())


def parameter_unit(effect: str, name: str, unit: str, vibration: str) -> str:
    """Return the unit of a parameter: that of the vibration for the size of a noise."""
    return vibration or unit if (effect, name) == (AdditiveNoise.name, 'std') else unit


# --- the section of a machine file ---------------------------------------------------------------

def new_section(trace: Trace, models: Mapping[str, DeclaredModel], *,
                ratio_is_stated: bool = False) -> str:
    """
    Return the section of `jitter_predictor` with what was found, '' where nothing was.

    It declares the `models` of all shafts, by their names, as before, with the effects added; what
    is new has a remark. A wrong ratio that a recording states, too, is declared as a clock skew.
    """
    found = {item.name: item.effect for item in (*trace.findings, *trace.refinements)
             if item.effect is not None}
    model, declared = trace.observation.model, {item.name: item for item in trace.declared}
    if not found and trace.noise is None:
        return ''
    named = set(models) != {ONLY_SHAFT}
    values: dict[str, Any] = {'shafts': list(models)} if named else {}
    for item in fields(model):
        places = {f'{shaft}.{item.name}': each for shaft, each in models.items()} if (
            named and item.name in _OF_SHAFT) else {item.name: model}
        for place, each in places.items():
            value = trace.observation.declared_speed if item.name == 'trigger_speed' else getattr(
                each, item.name)
            undeclared = item.name == 'noise_std' and not each.noise_is_declared
            if not undeclared and (item.default is MISSING or value != item.default):
                values[place] = value
    remarks = {}
    skew = found.get(ClockSkew.name)
    if isinstance(skew, ClockSkew) and skew.by_angle == 1.0 and not ratio_is_stated:
        del found[ClockSkew.name]
        for place in (f'{shaft}.ratio' if named else 'ratio' for shaft, each in models.items()
                      if (each.ratio, each.orders) == (model.ratio, model.orders)):
            values[place] = float(f'{skew.ratio(model):.{_DIGITS_OF_RATIO}g}')
            remarks[place] = f'was {model.ratio:.{_DIGITS_OF_RATIO}g}'
    if trace.noise is not None:
        values['noise_std'] = _short(trace.noise[0])
        remarks['noise_std'] = (f'was {model.noise_std:g}' if model.noise_is_declared
                                else 'measured')
    if declared or found:
        values['effects'] = {}
    for name, effect in {**declared, **found}.items():
        values['effects'][name] = {'enabled': True, **{
            key: _short(value) for key, value in effect.values.items()}}
        for key in values['effects'][name]:
            if name not in declared:
                remarks[f'effects.{name}.{key}'] = 'new'
            elif name in found and key != 'enabled':
                remarks[f'effects.{name}.{key}'] = f'was {declared[name].values[key]}'
    return section_text(_NODE, values, remarks)


def _short(value: Any) -> Any:
    """Return a number, or each of a list, without digits that mean nothing."""
    if isinstance(value, (tuple, list)):
        return [_short(item) for item in value]
    return float(f'{value:.{_DIGITS}g}') if isinstance(value, float) else value
