// The data of the page, and how its parts belong together.

import {format, known, withError} from './charts.js';

const TIMES = [[1, 's'], [1e-3, 'ms'], [1e-6, 'µs'], [1e-9, 'ns']];

export const state = {run: null, version: 0, now: 0, parts: {}, paused: false};
export const find = id => document.getElementById(id);
export const part = name => state.parts[name]?.content;
export const ofShaft = kind => part(`${find('shaft').value}/${kind}`);
export const channel = () => Number(find('channel').value || 0);
export const settings = () => part('settings')
  ?? {shafts: [], vibration_unit: '', channel_names: []};
export const unit = () => settings().vibration_unit || 'unit of the vibration';
export const channelName = i => settings().channel_names[i] ?? `channel ${i}`;
export const finite = values => values.filter(known);
// The part of the machine that makes an order of the shown shaft, and the order in a sentence.
const SAME = 1e-5;  // relative
export const nameOf = order => (settings().order_names?.[find('shaft').value] ?? []).find(
  ([, value]) => Math.abs(value - order) <= SAME * value)?.[0] ?? '';
export const words = order => nameOf(order) ? `${nameOf(order)} (${format(order, 6)})`
  : `order ${format(order, 6)}`;
// Of a condition indicator: those that are no ratios have the unit of the vibration.
export const unitOf = indicator => ['rms', 'peak'].includes(indicator) ? unit() : '';
// Several shafts have a prediction each.
export const prediction = () => ofShaft('prediction') ?? part('prediction');
// Values by the name of the node, of nodes that show a value `key` in their diagnostics.
const nodesWith = key => Object.values(part('/diagnostics') ?? {}).map(node => node.values)
  .filter(values => values[key]);

// What an analyser of the shown shaft published, and a note if there is one of another shaft only.
export function analysed(kind) {
  const own = ofShaft(kind), others = nodesWith('batches').map(values => values.shaft);
  if (own || !others.length || others.includes(find('shaft').value)) {
    return {content: own ?? part(kind), note: ''};
  }
  return {content: undefined, note: `residual_analyser compares shaft ${others.join(', ')}`};
}

// The changes that change_monitor has found: all of them, or those of one quantity of what is shown.
export const changes = () => part('change')?.changes ?? [];
export const changeOf = (kind, name) => changes().find(item => item.shaft === find('shaft').value
  && item.channel === channel() && item.kind === kind && (kind === 'order'
    ? Number(item.order ?? item.name) === Number(name) : item.name === name));
export const changeText = ({change, standard_error: error}) => (change > 0 ? '+' : '')
  + `${withError(100 * change, known(error) ? 100 * error : null)} %`;

// Why the correction of the shown shaft was refused last, '' if the last average was corrected.
export function refusal() {
  const attenuation = ofShaft('order_amplitude')?.attenuation ?? [];
  const key = `${find('shaft').value}.refusal`;
  return attenuation.flat().some(known) ? '' : nodesWith(key).map(values => values[key])[0] ?? '';
}

// The unit of time that suits a value.
export function timeUnit(value) {
  return TIMES.find(([size]) => Math.abs(value) >= 0.9995 * size) ?? TIMES.at(-1);
}

export function withTimeUnit(value, digits = 3) {
  if (!known(value)) return '–';
  const [size, name] = timeUnit(value);
  return `${format(value / size, digits)} ${name}`;
}

// The prediction for the shown shaft: {rows by order, note}; no rows if it is for another one.
export function predicted() {
  const found = prediction(), header = ofShaft('order_amplitude')?.header;
  if (!found) return {rows: new Map(), note: 'no prediction received'};
  if (header) {
    const turns = (header.end_time - header.start_time) * header.mean_trigger_speed;
    const excess = turns * found.ratio - header.fundamental_cycles;  // of whole cycles
    if (excess >= 2 || excess < -1e-3 * header.fundamental_cycles) {
      return {rows: new Map(), note: `prediction is for ratio ${format(found.ratio, 6)}, `
        + 'another shaft'};
    }
  }
  const rows = new Map(found.order.map((order, i) => [order, {
    mean: found.mean_attenuation[i], low: found.quantile_05[i],
    high: found.quantile_95[i]}]));
  const note = header && header.trigger_cycles !== found.trigger_cycles
    ? `predicted for ${found.trigger_cycles} trigger cycles, the average has `
      + `${header.trigger_cycles}` : '';
  return {rows, note};
}

// One object for each order of the shown channel.
export function orderRows() {
  const orders = ofShaft('order_amplitude');
  const rows = orders?.order[channel()] ?? [];
  const {rows: predictions} = predicted();
  return rows.map((order, i) => ({
    order, ...Object.fromEntries(['raw_amplitude', 'raw_phase', 'corrected_amplitude',
      'corrected_phase', 'attenuation', 'attenuation_standard_error', 'noise_standard_deviation',
      'raw_standard_error', 'raw_phase_standard_error', 'corrected_standard_error',
      'corrected_phase_standard_error', 'upper_95'].map(
      name => [name, orders[name]?.[channel()]?.[i] ?? null])),
    past: orders.history.slice(0, -1).map(average => average[channel()]?.[i]),
    predicted: predictions.get(order)}));
}

export function inBand({attenuation, attenuation_standard_error: error, predicted: row}) {
  if (!row || !known(attenuation) || !known(row.low)) return null;
  const slack = 2 * (error ?? 0);
  return attenuation >= row.low - slack && attenuation <= row.high + slack;
}
