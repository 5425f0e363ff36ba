// The data of the page, and how its parts belong together.

import {format, known} from './charts.js';

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
  const prediction = part('prediction'), header = ofShaft('order_amplitude')?.header;
  if (!prediction) return {rows: new Map(), note: 'no prediction received'};
  if (header) {
    const turns = (header.end_time - header.start_time) * header.mean_trigger_speed;
    const excess = turns * prediction.ratio - header.fundamental_cycles;  // of whole cycles
    if (excess >= 2 || excess < -1e-3 * header.fundamental_cycles) {
      return {rows: new Map(), note: `prediction is for ratio ${format(prediction.ratio, 6)}, `
        + 'another shaft'};
    }
  }
  const rows = new Map(prediction.order.map((order, i) => [order, {
    mean: prediction.mean_attenuation[i], low: prediction.quantile_05[i],
    high: prediction.quantile_95[i]}]));
  const note = header && header.trigger_cycles !== prediction.trigger_cycles
    ? `predicted for ${prediction.trigger_cycles} trigger cycles, the average has `
      + `${header.trigger_cycles}` : '';
  return {rows, note};
}

// One object for each order of the shown channel.
export function orderRows() {
  const orders = ofShaft('order_amplitude');
  const rows = orders?.order[channel()] ?? [];
  const {rows: predictions} = predicted();
  return rows.map((order, i) => ({
    order, ...Object.fromEntries(['raw_amplitude', 'corrected_amplitude', 'attenuation',
      'attenuation_standard_error', 'noise_standard_deviation'].map(
      name => [name, orders[name][channel()][i]])),
    past: orders.history.slice(0, -1).map(average => average[channel()]?.[i]),
    predicted: predictions.get(order)}));
}

export function inBand({attenuation, attenuation_standard_error: error, predicted: row}) {
  if (!row || !known(attenuation) || !known(row.low)) return null;
  const slack = 2 * (error ?? 0);
  return attenuation >= row.low - slack && attenuation <= row.high + slack;
}
