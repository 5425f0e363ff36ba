// The order spectrum, the trend, and the average over the circle.

import {Chart, format, known, linear, logarithmic, range, withError} from './charts.js';
import {changeOf, changeText, channel, channelName, find, finite, ofShaft, state, unit, unitOf,
        words} from './model.js';

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
  if (!shown.length) {
    find('spectrum-note').textContent = '';
    chart.empty(missing());
    return;
  }
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
    const choice = find('spectrum-order');
    if (choice !== document.activeElement) choice.value = known(chart.kept) ? order : '';
    choice.max = most;
    find('spectrum-note').textContent = order === null
      ? 'point at an order; click, or type its number, to keep it' : `${words(order)}: ` + shown.map(
        ([kind, amplitudes, phases]) => `${kind} ${format(amplitudes[order - 1])} ${unit()}`
          + (known(phases[order - 1]) ? ` at ${(phases[order - 1] * 180 / Math.PI).toFixed(1)}°`
            : '')).join(', ');
    return order === null ? null : order / (most + 1);
  }, most + 1);
}

// Keeps the cursor at the order that is typed; without one it follows the pointer.
export function keepOrder(chart) {
  const order = find('spectrum-order').valueAsNumber;
  chart.kept = order >= 1 ? order : null;
  chart.render();
}

export function spectrumTable() {
  const shown = spectra();
  return shown.length && {
    columns: ['order', ...shown.flatMap(([kind]) => [`${kind} amplitude [${unit()}]`,
                                                     `${kind} phase [rad]`])],
    rows: shown[0][1].map((_, i) => [i + 1, ...shown.flatMap(
      ([, amplitudes, phases]) => [amplitudes[i], phases[i]])])};
}

// --- trends --------------------------------------------------------------------------------------

const trendCharts = new Map();  // by choice: 'order 19', 'indicator rms'
let chosen = null;  // until somebody chooses: strongest order, first indicator, what has changed
const MOST_CHANGED = 4;
const LEAST_STEP = 6;  // pixels from average to average that leave room for error bars

const namesOf = kind => ofShaft(kind === 'order' ? 'raw_trend' : 'indicator_trend')?.names ?? [];
const choices = () => ['order', 'indicator'].flatMap(
  kind => namesOf(kind).map(name => `${kind} ${name}`));
const parted = choice => [choice.slice(0, choice.indexOf(' ')),
                          choice.slice(choice.indexOf(' ') + 1)];
const titleOf = choice => {
  const [kind, name] = parted(choice);
  return kind === 'order' ? words(Number(name)) : name.replaceAll('_', ' ');
};

function shownTrends() {
  const possible = choices();
  if (chosen) return possible.filter(choice => chosen.has(choice));
  const last = shownPart('raw_trend')?.value.at(-1) ?? [];
  const strongest = last.indexOf(Math.max(...finite(last)));
  const changed = possible.filter(choice => changeOf(...parted(choice))).slice(0, MOST_CHANGED);
  return possible.filter((choice, i) => i === Math.max(strongest, 0)
    || i === namesOf('order').length || changed.includes(choice));
}

// The choices as boxes, and a chart for each that is chosen.
export function drawTrends() {
  const possible = choices(), shown = shownTrends(), box = find('trend-of').lastElementChild;
  const inputs = [...box.querySelectorAll('input')];
  if (inputs.map(input => input.value).join() !== possible.join()) {
    box.replaceChildren(...possible.map(choice => {
      const label = document.createElement('label'), input = document.createElement('input');
      Object.assign(input, {type: 'checkbox', value: choice, onchange: () => {
        chosen = new Set([...box.querySelectorAll(':checked')].map(item => item.value));
        drawTrends();
      }});
      label.append(input, titleOf(choice));
      return label;
    }));
  }
  for (const input of box.querySelectorAll('input')) input.checked = shown.includes(input.value);
  for (const [choice, chart] of trendCharts) {
    if (shown.includes(choice)) continue;
    chart.container.remove();
    trendCharts.delete(choice);
  }
  for (const choice of shown) {
    const chart = trendCharts.get(choice) ?? new Chart(
      document.createElement('div'), 220, item => drawTrend(item, choice));
    trendCharts.set(choice, chart);
    if (!chart.container.isConnected) find('trend').append(chart.container);
    chart.render();
  }
}

// {name, measure, curves: [kind, times, values, errors]} of what was chosen.
function trend(choice) {
  const [what, name] = parted(choice), place = namesOf(what).indexOf(name);
  const parts = what === 'order' ? KINDS.map(([kind]) => [kind, shownPart(`${kind}_trend`)])
    : [['corrected', shownPart('indicator_trend')]];
  const curves = parts.filter(([, content]) => content).map(([kind, content]) => [
    kind, content.time, ...['value', 'error'].map(
      key => content[key].map(average => average[place] ?? null))]);
  return {name: titleOf(choice), measure: what === 'order' ? unit() : unitOf(name),
          curves: curves.filter(([, , values]) => values.some(known)),
          change: changeOf(what, name)};
}

function drawTrend(chart, choice) {
  const {name, measure, curves, change} = trend(choice);
  if (!curves.length) { chart.empty(`${name}: ${missing()}`); return; }
  const times = curves.flatMap(([, time]) => finite(time));
  const last = Math.max(...times), first = Math.min(...times), span = last - first;
  const [size, letter] = SPANS.find(([seconds]) => span >= 3 * seconds) ?? SPANS.at(-1);
  const limits = curves.flatMap(([, , values, errors]) => values.flatMap((value, i) =>
    known(value) ? [value - 2 * (errors[i] ?? 0), value + 2 * (errors[i] ?? 0)] : []));
  chart.axes({
    x: linear([-(span || 1) / size * 1.03, 0.02 * (span || 1) / size],
              Math.max(4, Math.min(10, chart.inner / 80))),
    xLabel: `end of the average before the last one [${letter}]`, y: linear(range(limits), 4),
    yLabel: `${choice.startsWith('order ') ? 'amplitude' : name}${measure ? ` [${measure}]` : ''}`,
    title: name + (change ? `: ${changeText(change)} since average ${change.since_sequence}` : '')});
  if (change && change.since_time >= first) {
    chart.upright('change', (change.since_time - last) / size,
                  `changed since average ${change.since_sequence}`);
  }
  for (const [kind, time, values, errors] of curves) {
    const xs = time.map(item => (item - last) / size);
    const dense = LEAST_STEP * xs.length > chart.inner;  // bars would touch
    if (dense) {
      chart.between(`spread ${kind}`, i => xs[i], ...[-2, 2].map(width => values.map((value, i) =>
        known(value) && known(errors[i]) ? value + width * errors[i] : null)));
    }
    chart.curve(`thin ${kind}`, i => xs[i], values);
    values.forEach((value, i) => chart.mark(kind, xs[i], value, {
      size: dense ? 0.7 : 2, square: kind === 'corrected',
      error: known(errors[i]) && !dense ? 2 * errors[i] : null,
      tip: `average that ended at ${format(time[i], 9)} s: ${kind} `
        + `${withError(value, errors[i])} ${measure}`}));
  }
}

// The chosen trends side by side, a row for each average of any of them.
export function trendTable() {
  const columns = [], rows = new Map();
  for (const choice of shownTrends()) {
    const {name, measure, curves} = trend(choice);
    for (const [kind, times, values, errors] of curves) {
      const label = `${name}${curves.length > 1 ? ` ${kind}` : ''}`;
      const unitText = measure ? ` [${measure}]` : '', place = columns.length;
      columns.push(label + unitText, `standard error of ${label}${unitText}`);
      times.forEach((time, i) => {
        const row = rows.get(time) ?? rows.set(time, []).get(time);
        [row[place], row[place + 1]] = [values[i], errors[i]];
      });
    }
  }
  return columns.length && {
    columns: ['end of the average [s]', ...columns],
    rows: [...rows].sort(([a], [b]) => a - b).map(([time, row]) => [
      time, ...columns.map((_, i) => row[i] ?? null)])};
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

const timeOf = time => SPANS.find(([seconds]) => time.at(-1) - time[0] >= 3 * seconds)
  ?? SPANS.at(-1);

// Rows of a picture, the latest at the top: at round times before the last one, whatever their gaps.
function rowAxis(time) {
  const [size] = timeOf(time), last = time.at(-1), count = time.length;
  const ages = time.map(item => (last - item) / size);
  const ticks = linear([0, Math.max(ages[0], 1e-9)], 5).ticks.map(([age, label]) => {
    const row = ages.findIndex(item => item <= age * (1 + 1e-9));
    const next = row > 0 ? (ages[row - 1] - age) / (ages[row - 1] - ages[row] || 1) : 1;
    return [row < 0 ? count - 1 : row > 0 ? row - 1 + next : 0, label];
  }).filter(([row], i, all) => i === 0 || all[i - 1][0] - row > 0.08 * count);  // they would touch
  return {at: row => (row + 0.5) / count, ticks};
}

export function drawMap(chart) {
  const [kind, map] = orderMap() ?? [];
  find('map-note').textContent = map ? `${kind}, ${channelName(channel())}: yellow `
    + `${format(map.peak, 3)} ${unit()}, violet ${map.span} dB less` : '';
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
    y: rowAxis(map.time), xLabel: `order of ${find('shaft').value}`,
    yLabel: `time before the last [${timeOf(map.time)[1]}]`});
  chart.picture(canvas.toDataURL());
}

export function mapTable() {
  const [, map] = orderMap() ?? [];
  return map && {
    columns: ['end of the average [s]', ...Array.from(map.rows[0], (_, i) =>
      `amplitude of order ${map.pool * i + 1} [dB re ${format(map.peak)} ${unit()}]`)],
    rows: map.rows.map((row, y) => [map.time[y], ...Array.from(
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
