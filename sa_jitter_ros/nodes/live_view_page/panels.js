// The order spectrum, the trend, and the average over the circle.

import {Chart, format, known, linear, logarithmic, range} from './charts.js';
import {channel, channelName, find, finite, ofShaft, state, unit, unitOf} from './model.js';

const FLOOR = 1e-6;  // of the largest amplitude: smaller ones are rounding errors
const SPANS = [[3600, 'h'], [60, 'min'], [1, 's']];
const KINDS = [['raw', 'synchronous_average'], ['corrected', 'corrected_average']];

// --- order spectrum ------------------------------------------------------------------------------

// What was sent for the shown channel; the rest comes with the next answer.
const shownPart = kind => ofShaft(kind)?.channel === channel() ? ofShaft(kind) : undefined;

const missing = () => !ofShaft('synchronous_average') ? 'no synchronous average received yet'
  : state.paused ? 'continue, to see this channel' : 'not received yet';

// [kind, amplitudes, phases] of the averages that there are.
function spectra() {
  return KINDS.map(([kind, topic]) => [kind, shownPart(`${topic}_spectrum`)])
    .filter(([, content]) => content?.amplitude.length)
    .map(([kind, {amplitude, phase}]) => [kind, amplitude, phase]);
}

export function drawSpectrum(chart) {
  const shown = spectra();
  if (!shown.length) { chart.empty(missing()); return; }
  const peak = Math.max(...shown.flatMap(([, amplitudes]) => finite(amplitudes)));
  const most = Math.max(...shown.map(([, amplitudes]) => amplitudes.length));
  const x = linear([0, most + 1], Math.max(4, Math.min(12, chart.inner / 70)));
  chart.axes({
    x, xLabel: `order of ${find('shaft').value}`, title: channelName(channel()),
    y: logarithmic(shown.flatMap(([, amplitudes]) => amplitudes.filter(
      value => value > FLOOR * peak))), yLabel: `amplitude [${unit()}]`});
  for (const [kind, amplitudes] of shown) {
    const shift = shown.length > 1 ? (kind === 'raw' ? -0.12 : 0.12) : 0;
    chart.stems(kind, i => i + 1 + shift, amplitudes);
  }
  chart.follow(position => {
    const order = position === null ? null
      : Math.min(Math.max(Math.round(position * (most + 1)), 1), most);
    find('spectrum-note').textContent = order === null
      ? 'point at an order, or click to keep it' : `order ${order}: ` + shown.map(
        ([kind, amplitudes, phases]) => `${kind} ${format(amplitudes[order - 1])} ${unit()}`
          + (known(phases[order - 1]) ? ` at ${(phases[order - 1] * 180 / Math.PI).toFixed(1)}°`
            : '')).join(', ');
    return order === null ? null : order / (most + 1);
  });
}

export function spectrumTable() {
  const shown = spectra();
  return shown.length && {
    columns: ['order', ...shown.flatMap(([kind]) => [`${kind} amplitude [${unit()}]`,
                                                     `${kind} phase [rad]`])],
    rows: shown[0][1].map((_, i) => [i + 1, ...shown.flatMap(
      ([, amplitudes, phases]) => [amplitudes[i], phases[i]])])};
}

// --- trend ---------------------------------------------------------------------------------------

// What can be chosen: [value of the option, text].
export function trendChoices() {
  const orders = ofShaft('raw_trend')?.names ?? [];
  const indicators = ofShaft('indicator_trend')?.names ?? [];
  return [...orders.map((name, i) => [`order ${i}`, `order ${name}`]),
          ...indicators.map((name, i) => [`indicator ${i}`, name.replaceAll('_', ' ')])];
}

// {name, unit, curves: [kind, times, values, errors]} of what was chosen.
function trend() {
  const [what, place] = (find('trend-of').value || 'order 0').split(' ');
  const parts = what === 'order' ? KINDS.map(([kind]) => [kind, shownPart(`${kind}_trend`)])
    : [['corrected', shownPart('indicator_trend')]];
  const curves = parts.filter(([, content]) => content).map(([kind, content]) => [
    kind, content.time, ...['value', 'error'].map(
      key => content[key].map(average => average[place] ?? null))]);
  const name = parts[0][1]?.names[place] ?? '';
  return {name: what === 'order' ? `order ${name}` : name.replaceAll('_', ' '),
          measure: what === 'order' ? unit() : unitOf(name),
          curves: curves.filter(([, , values]) => values.some(known))};
}

export function drawTrend(chart) {
  const {name, measure, curves} = trend();
  if (!curves.length) { chart.empty(missing()); return; }
  const times = curves.flatMap(([, time]) => finite(time));
  const last = Math.max(...times), span = last - Math.min(...times);
  const [size, letter] = SPANS.find(([seconds]) => span >= 3 * seconds) ?? SPANS.at(-1);
  const limits = curves.flatMap(([, , values, errors]) => values.flatMap((value, i) =>
    known(value) ? [value - 2 * (errors[i] ?? 0), value + 2 * (errors[i] ?? 0)] : []));
  chart.axes({
    x: linear([-(span || 1) / size * 1.03, 0.02 * (span || 1) / size]),
    xLabel: `end of the average before the last one [${letter}]`, y: linear(range(limits)),
    yLabel: measure ? `amplitude [${measure}]` : name, title: `${name}, ${channelName(channel())}`});
  for (const [kind, time, values, errors] of curves) {
    const xs = time.map(item => (item - last) / size);
    chart.curve(`thin ${kind}`, i => xs[i], values);
    values.forEach((value, i) => chart.mark(kind, xs[i], value, {
      size: 2, square: kind === 'corrected', error: known(errors[i]) ? 2 * errors[i] : null,
      tip: `average that ended at ${format(time[i], 9)} s: ${kind} ${format(value)} `
        + `${known(errors[i]) ? `± ${format(errors[i], 2)} ` : ''}${measure}`}));
  }
}

export function trendTable() {
  const {name, measure, curves} = trend();
  const label = kind => `${name}${curves.length > 1 ? ` ${kind}` : ''}`;
  const unitText = measure ? ` [${measure}]` : '';
  return curves.length && {
    columns: ['end of the average [s]', ...curves.flatMap(
      ([kind]) => [label(kind) + unitText, `standard error of ${label(kind)}${unitText}`])],
    rows: curves[0][1].map((time, i) => [time, ...curves.flatMap(
      ([, , values, errors]) => [values[i] ?? null, errors[i] ?? null])])};
}

// --- order map -----------------------------------------------------------------------------------

// Colours from small to large amplitudes, which also differ in lightness.
const COLOURS = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];

function colour(level) {
  const place = level * (COLOURS.length - 1), low = Math.min(Math.floor(place), COLOURS.length - 2);
  return COLOURS[low].map((value, i) => value + (place - low) * (COLOURS[low + 1][i] - value));
}

const orderMap = () => [...KINDS].reverse().map(([kind, topic]) => [
  kind, shownPart(`${topic}_map`)]).find(([, content]) => content?.rows.length);

export function drawMap(chart) {
  const [kind, map] = orderMap() ?? [];
  if (!map) { chart.empty(missing()); return; }
  const width = map.rows[0].length, height = map.rows.length;
  const canvas = document.createElement('canvas');
  Object.assign(canvas, {width, height});
  const context = canvas.getContext('2d'), image = context.createImageData(width, height);
  map.rows.forEach((row, y) => {
    for (let x = 0; x < width; ++x) {
      image.data.set([...colour((row.charCodeAt(x) - 48) / 63), 255],
                     4 * ((height - 1 - y) * width + x));  // the latest at the top
    }
  });
  context.putImageData(image, 0, 0);
  chart.axes({
    x: linear([0.5, map.pool * width + 0.5], Math.max(4, Math.min(12, chart.inner / 70))),
    y: linear([map.step * (height - 0.5), -0.5 * map.step]), xLabel:
      `order of ${find('shaft').value}`, yLabel: 'averages before the last one',
    title: `${kind}, ${channelName(channel())}: yellow ${format(map.peak, 3)} ${unit()}, `
      + `violet ${map.span} dB less`});
  chart.picture(canvas.toDataURL());
}

export function mapTable() {
  const [, map] = orderMap() ?? [];
  return map && {
    columns: ['averages before the last one', ...Array.from(map.rows[0], (_, i) =>
      `amplitude of order ${map.pool * i + 1} [dB re ${format(map.peak)} ${unit()}]`)],
    rows: map.rows.map((row, y) => [map.step * (map.rows.length - 1 - y), ...Array.from(
      row, item => ((item.charCodeAt(0) - 48) / 63 - 1) * map.span)])};
}

// --- the average over the circle -----------------------------------------------------------------

export function drawPolar(chart) {
  const shown = KINDS.map(([kind, topic]) => [kind, ofShaft(topic)?.channels[channel()]])
    .filter(([, values]) => values?.some(known));
  if (!shown.length) { chart.empty('no synchronous average received yet'); return; }
  const peak = Math.max(...shown.flatMap(([, values]) => finite(values).map(Math.abs))) || 1;
  chart.circle({peak, label: `${format(peak, 3)} ${unit()}`, title: channelName(channel())});
  for (const [kind, values] of shown) chart.around(kind, values, peak);
}
