// The charts of the page.

import {Chart, format, known, linear, logarithmic, places, range, withError} from './charts.js';
import {analysed, channel, channelName, find, finite, nameOf, ofShaft, orderRows, part, predicted,
        prediction, refusal, timeUnit, unit, withTimeUnit, words} from './model.js';

const FEW = 6;  // channels that have the full width and height

const waveformCharts = [];

export function drawWaveforms() {
  const raw = ofShaft('synchronous_average'), box = find('waveforms');
  const count = raw ? raw.channels.length : 1;
  box.className = count > FEW ? 'many' : '';
  while (waveformCharts.length > count) { waveformCharts.pop(); box.lastChild.remove(); }
  while (waveformCharts.length < count) {
    const place = waveformCharts.length;
    const div = box.appendChild(document.createElement('div'));
    waveformCharts.push(new Chart(div, 0, chart => drawWaveform(chart, place)));
  }
  for (const chart of waveformCharts) {
    chart.height = count > FEW ? 130 : 170;
    chart.render();
  }
  find('waveform-axes').textContent = raw ? `vibration [${unit()}] over the angle of `
    + `${find('shaft').value} [degrees]` + (raw.count > count
      ? `; the first ${count} of ${raw.count} channels` : '') : '';
}

function drawWaveform(chart, place) {
  const raw = ofShaft('synchronous_average'), corrected = ofShaft('corrected_average');
  if (!raw) { chart.empty('no synchronous average received yet'); return; }
  // The corrected average arrives after the raw one: until then the one before is shown.
  const fresh = corrected && Math.abs(raw.header.sequence - corrected.header.sequence) < 2;
  const spread = standardError(raw)?.channels[place];
  const limits = [-2, 2].map(factor => raw.channels[place].map((value, i) =>
    known(value) && known(spread?.[i]) ? value + factor * spread[i] : null));
  const curves = [['raw', raw.channels[place]],
                  ['corrected', fresh ? corrected.channels[place] : null]]
    .filter(([, values]) => values);
  const x = linear([0, 360]), step = chart.inner > 500 ? 45 : 90;
  x.ticks = Array.from({length: 360 / step + 1}, (_, i) => [i * step, `${i * step}`]);
  chart.axes({
    x, y: linear(range([...limits.flat(), ...curves.flatMap(([, values]) => values)]), 4),
    title: channelName(place), xLabel: '', yLabel: ''});
  chart.between('spread', i => 360 * i / limits[0].length, ...limits);
  for (const [style, values] of curves) {
    chart.curve(style, i => 360 * i / values.length, values);
  }
  const note = fresh ? '' : `no corrected average${refusal() ? `: ${refusal()}` : ''}`;
  chart.follow(position => {
    find('waveform-note').textContent = position === null ? note
      : `${channelName(place)} at ${(360 * position).toFixed(1)}°: ` + [
        ...curves, ...(spread ? [['standard error', spread]] : [])].map(
        ([style, values]) => `${style} ` + format(
          values[Math.min(Math.round(position * values.length), values.length - 1)])).join(', ')
        + ` ${unit()}`;
  });
}

export function waveformTable() {
  const raw = ofShaft('synchronous_average'), corrected = ofShaft('corrected_average');
  if (!raw) return null;
  const curves = raw.channels.flatMap((values, i) => [
    [`raw ${channelName(i)} [${unit()}]`, values],
    ...(corrected?.channels[i] ? [[`corrected ${channelName(i)} [${unit()}]`,
                                   corrected.channels[i]]] : [])]);
  return {columns: [`angle of ${find('shaft').value} [degrees]`, ...curves.map(([name]) => name)],
          rows: raw.channels[0].map((_, i) => [360 * i / raw.channels[0].length,
                                               ...curves.map(([, values]) => values[i])])};
}

// The standard error of this average, null where it is not published.
function standardError(raw) {
  const error = ofShaft('standard_error');
  return error?.header.sequence === raw.header.sequence && error.points === raw.points
    ? error : null;
}

function orderAxis(chart, rows) {
  return places(rows.map(row => format(row.order, 6)), chart.inner);
}

export function drawAmplitudes(chart) {
  const rows = orderRows();
  if (!rows.length) { chart.empty('no order amplitudes received yet'); return; }
  chart.axes({
    x: orderAxis(chart, rows), xLabel: `order of ${find('shaft').value}`,
    y: logarithmic(rows.flatMap(row => [row.raw_amplitude, row.corrected_amplitude,
                                        row.noise_standard_deviation])),
    yLabel: `amplitude [${unit()}]`, title: channelName(channel())});
  rows.forEach((row, i) => {
    const tip = `${words(row.order)}: raw ${format(row.raw_amplitude)}, corrected `
      + `${format(row.corrected_amplitude)}, noise ${format(row.noise_standard_deviation)}`;
    chart.dash('noise', i, row.noise_standard_deviation, 0.35, tip);
    for (const [kind, shift] of [['raw', -0.1], ['corrected', 0.1]]) {
      const error = row[`${kind}_standard_error`];
      chart.mark(kind, i + shift, row[`${kind}_amplitude`], {
        square: kind === 'corrected', tip, error: known(error) ? 2 * error : null});
    }
  });
}

export function drawAttenuation(chart) {
  const rows = orderRows(), {note} = predicted();
  const measured = rows.some(row => known(row.attenuation));
  if (!measured && !rows.some(row => row.predicted)) {
    chart.empty(rows.length ? `no attenuation measured; ${refusal() || note}`
      : 'nothing received yet');
    return;
  }
  const values = rows.flatMap(row => [row.attenuation, ...row.past, row.predicted?.low,
                                      row.predicted?.high]);
  chart.axes({
    x: orderAxis(chart, rows), xLabel: `order of ${find('shaft').value}`,
    y: linear(range(values, {include: [1]})), yLabel: 'attenuation',
    title: note || channelName(channel())});
  chart.level('zero', 1);
  rows.forEach((row, i) => {
    const name = words(row.order), band = row.predicted;
    if (band) {
      const tip = `${name}: predicted ${format(band.mean)}, 5 % to 95 %: ${format(band.low)} to `
        + format(band.high);
      chart.band(i - 0.35, i + 0.35, band.low, band.high, tip);
      chart.dash('predicted', i, band.mean, 0.35, tip);
    }
    row.past.forEach((value, k) => chart.mark(
      'past', i + 0.24 * (((k * 0.618) % 1) - 0.5), value, {size: 2.5}));
    const error = row.attenuation_standard_error;
    chart.mark('measured', i, row.attenuation, {
      error: known(error) ? 2 * error : null,
      tip: `${name}: measured ${withError(row.attenuation, error)}`});
  });
}

export function drawErrors(chart) {
  const pulses = ofShaft('pulse_error');
  if (!pulses) {
    chart.empty(refusal() || 'no pulse errors recovered yet (correct_jitter)');
    return;
  }
  const declared = prediction()?.pulse_error_standard_deviation;
  const bars = pulses.error.flatMap((error, i) => known(error)
    ? [error - (pulses.standard_error[i] ?? 0), error + (pulses.standard_error[i] ?? 0)] : []);
  const limits = known(declared) ? [-declared, declared] : [];
  const [low, high] = range(bars, {include: limits});
  const [size, name] = timeUnit(Math.max(-low, high) / 2);
  const last = Math.max(...finite(pulses.time));
  const start = Math.min(...finite(pulses.time)) - last;
  chart.axes({
    x: linear([start || -1, 0]), xLabel: 'time before the last pulse [s]',
    y: linear([low / size, high / size]), yLabel: `pulse error [${name}]`});
  if (known(declared)) chart.band(start || -1, 0, -declared / size, declared / size);
  chart.level('zero', 0);
  pulses.error.forEach((error, i) => {
    const spread = pulses.standard_error[i];
    if (known(error) && known(pulses.time[i])) {
      chart.mark('corrected', pulses.time[i] - last, error / size, {
        error: known(spread) ? spread / size : null, size: 2,
        tip: `pulse at ${format(pulses.time[i], 9)} s: ${withTimeUnit(error)} ± `
          + withTimeUnit(spread, 2)});
    }
  });
}

export function drawResidual(chart) {
  const {content: residual, note} = analysed('residual');
  const lines = analysed('missing_effect').content?.lines ?? [];
  if (!residual && !lines.length) {
    chart.empty(note || 'no residual received (residual_analyser)');
    return;
  }
  const orders = [...new Set([...(residual?.order ?? []), ...lines.map(line => line.order)])]
    .filter(known).sort((a, b) => a - b);
  const before = lines.map(line => line.observed - line.predicted_before);
  const after = lines.map(line => line.observed - line.predicted_after);
  const bars = (residual?.residual ?? []).flatMap((value, i) => known(value)
    ? [value - 2 * (residual.standard_error[i] ?? 0), value + 2 * (residual.standard_error[i] ?? 0)]
    : []);
  chart.axes({
    x: places(orders.map(order => format(order, 6)), chart.inner), xLabel: `order of ${find('shaft').value}`,
    y: linear(range([...before, ...after, ...bars], {include: [0]})),
    yLabel: 'observed − predicted'});
  chart.level('zero', 0);
  const at = order => orders.indexOf(order);
  lines.forEach((line, i) => {
    chart.mark('past', at(line.order) - 0.15, before[i], {
      tip: `${line.channel}, ${words(line.order)}: ${format(before[i])} with the declared model`});
    chart.mark('corrected', at(line.order) + 0.15, after[i], {square: true,
      tip: `${line.channel}, ${words(line.order)}: ${format(after[i])} with the traced effects`});
  });
  residual?.order.forEach((order, i) => chart.mark('measured', at(order), residual.residual[i], {
    error: known(residual.standard_error[i]) ? 2 * residual.standard_error[i] : null,
    tip: `${words(order)}: ${withError(residual.residual[i], residual.standard_error[i])}, z = `
      + `${format(residual.z[i], 3)}`}));
}

export function drawSpeedLine() {
  const speeds = part('shaft_speed')?.history ?? [], box = find('speed-line');
  const svg = document.createElementNS('http://www.w3.org/2000/svg', 'svg');
  const path = svg.appendChild(document.createElementNS(svg.namespaceURI, 'path'));
  const {at} = linear(range(speeds));
  path.setAttribute('class', 'curve corrected');
  path.setAttribute('vector-effect', 'non-scaling-stroke');
  path.setAttribute('d', speeds.map((value, i) => `${i ? 'L' : 'M'}`
    + `${100 * i / Math.max(1, speeds.length - 1)} ${18 * (1 - at(value)) + 1}`).join(''));
  svg.setAttribute('viewBox', '0 0 100 20');
  svg.setAttribute('preserveAspectRatio', 'none');
  svg.setAttribute('height', 20);
  box.replaceChildren(svg);
}

// --- tables of what the charts show --------------------------------------------------------------

export function ordersTable() {
  const rows = orderRows();
  return rows.length && {
    columns: ['order', 'part', ...['raw', 'corrected'].flatMap(kind => [
      `${kind} amplitude [${unit()}]`, `its standard error [${unit()}]`, `${kind} phase [rad]`,
      'its standard error [rad]']), `upper limit at 95 % [${unit()}]`, `noise [${unit()}]`,
              'attenuation', 'standard error of the attenuation', 'predicted attenuation',
              'predicted 5 %', 'predicted 95 %'],
    rows: rows.map(row => [
      row.order, nameOf(row.order), ...['raw', 'corrected'].flatMap(kind => ['amplitude', 'standard_error', 'phase',
        'phase_standard_error'].map(name => row[`${kind}_${name}`])), row.upper_95,
      row.noise_standard_deviation, row.attenuation, row.attenuation_standard_error,
      row.predicted?.mean, row.predicted?.low, row.predicted?.high])};
}

export function errorsTable() {
  const pulses = ofShaft('pulse_error');
  return pulses && {
    columns: ['time [s]', 'pulse error [s]', 'standard error [s]'],
    rows: pulses.time.map((time, i) => [time, pulses.error[i], pulses.standard_error[i]])};
}

export function residualTable() {
  const residual = analysed('residual').content;
  return residual && {
    columns: ['order', 'observed', 'predicted', 'residual', 'standard error', 'z'],
    rows: residual.order.map((order, i) => [order, ...[
      'observed', 'predicted', 'residual', 'standard_error', 'z'].map(name => residual[name][i])])};
}
