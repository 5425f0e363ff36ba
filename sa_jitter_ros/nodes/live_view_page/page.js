// The page: asks for what is new twice a second and draws it.

import {Chart, format, known, linear, logarithmic, places, range} from './charts.js';

const PERIOD = 500;  // ms between questions
const CURVES = 6;  // channels whose waveform is shown at once
const LEVELS = [['ok', 'OK'], ['warn', 'WARN'], ['error', 'ERROR'], ['error', 'STALE']];
const LOSSES = /dropped|gaps|restarts|clock_deviation|rejected|refused/;
const TIMES = [[1, 's'], [1e-3, 'ms'], [1e-6, 'µs'], [1e-9, 'ns']];

const state = {run: null, version: 0, now: 0, parts: {}, paused: false};
const find = id => document.getElementById(id);
const part = name => state.parts[name]?.content;
const ofShaft = kind => part(`${find('shaft').value}/${kind}`);
const channel = () => Number(find('channel').value || 0);
const settings = () => part('settings') ?? {shafts: [], vibration_unit: '', channel_names: []};
const unit = () => settings().vibration_unit || 'unit of the vibration';
const channelName = i => settings().channel_names[i] ?? `channel ${i}`;
const finite = values => values.filter(known);
const rms = values => Math.sqrt(values.reduce((sum, x) => sum + x * x, 0) / values.length);

// The unit of time in which a value reads well.
function timeUnit(value) {
  return TIMES.find(([size]) => Math.abs(value) >= 0.9995 * size) ?? TIMES.at(-1);
}

function withTimeUnit(value, digits = 3) {
  if (!known(value)) return '–';
  const [size, name] = timeUnit(value);
  return `${format(value / size, digits)} ${name}`;
}

// --- what belongs together -----------------------------------------------------------------------

// The prediction for the shown shaft: {rows by order, note}; no rows if it is for another one.
function predicted() {
  const prediction = part('prediction'), header = ofShaft('order_amplitude')?.header;
  if (!prediction) return {rows: new Map(), note: 'no prediction received'};
  if (header) {
    const turns = (header.end_time - header.start_time) * header.mean_trigger_speed;
    const missed = turns * prediction.ratio - header.fundamental_cycles;  // whole ones count
    if (missed >= 2 || missed < -1e-3 * header.fundamental_cycles) {
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

// One object an order of the shown channel.
function orderRows() {
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

function inBand({attenuation, attenuation_standard_error: error, predicted: row}) {
  if (!row || !known(attenuation) || !known(row.low)) return null;
  const slack = 2 * (error ?? 0);
  return attenuation >= row.low - slack && attenuation <= row.high + slack;
}

// --- charts --------------------------------------------------------------------------------------

const waveformCharts = [];

function drawWaveforms() {
  const raw = ofShaft('synchronous_average'), box = find('waveforms');
  const count = raw ? Math.min(CURVES, raw.channels.length) : 1;
  while (waveformCharts.length > count) { waveformCharts.pop(); box.lastChild.remove(); }
  while (waveformCharts.length < count) {
    const place = waveformCharts.length;
    const div = box.appendChild(document.createElement('div'));
    waveformCharts.push(new Chart(div, 190, chart => drawWaveform(chart, place)));
  }
  waveformCharts.forEach(chart => chart.render());
}

function drawWaveform(chart, place) {
  const raw = ofShaft('synchronous_average'), corrected = ofShaft('corrected_average');
  if (!raw) { chart.empty('no synchronous average received yet'); return; }
  const first = Math.max(0, Math.min(channel(), raw.channels.length - CURVES));
  const shown = raw.channels.length > CURVES ? first + place : place;
  // The two arrive one after the other: that of the average before is as good.
  const fresh = corrected && Math.abs(raw.header.sequence - corrected.header.sequence) < 2;
  const curves = [['raw', raw.channels[shown]],
                  ['corrected', fresh ? corrected.channels[shown] : null]]
    .filter(([, values]) => values);
  const x = linear([0, 360]);
  x.ticks = [0, 45, 90, 135, 180, 225, 270, 315, 360].map(value => [value, `${value}`]);
  chart.axes({
    x, y: linear(range(curves.flatMap(([, values]) => values)), 4), title: channelName(shown),
    xLabel: `angle of ${find('shaft').value} [degrees]`, yLabel: `[${unit()}]`});
  for (const [style, values] of curves) {
    chart.curve(style, i => 360 * i / values.length, values);
  }
  const usual = waveformNote(raw, fresh);
  chart.follow(position => {
    find('waveform-note').textContent = position === null ? usual
      : `${channelName(shown)} at ${(360 * position).toFixed(1)}°: ` + curves.map(
        ([style, values]) => `${style} ` + format(
          values[Math.min(Math.round(position * values.length), values.length - 1)])).join(', ');
  });
}

function waveformNote(raw, fresh) {
  const all = raw.channels.length;
  return (fresh ? '' : 'no corrected average ') + (all > CURVES
    ? `${CURVES} of ${all} channels, from the chosen one on` : '');
}

function orderAxis(chart, rows) {
  return places(rows.map(row => format(row.order, 6)), chart.inner);
}

function drawAmplitudes(chart) {
  const rows = orderRows();
  if (!rows.length) { chart.empty('no order amplitudes received yet'); return; }
  chart.axes({
    x: orderAxis(chart, rows), xLabel: `order of ${find('shaft').value}`,
    y: logarithmic(rows.flatMap(row => [row.raw_amplitude, row.corrected_amplitude,
                                        row.noise_standard_deviation])),
    yLabel: `amplitude [${unit()}]`, title: channelName(channel())});
  rows.forEach((row, i) => {
    const tip = `order ${format(row.order, 6)}: raw ${format(row.raw_amplitude)}, corrected `
      + `${format(row.corrected_amplitude)}, noise ${format(row.noise_standard_deviation)}`;
    chart.dash('noise', i, row.noise_standard_deviation, 0.35, tip);
    chart.mark('raw', i - 0.1, row.raw_amplitude, {tip});
    chart.mark('corrected', i + 0.1, row.corrected_amplitude, {square: true, tip});
  });
}

function drawAttenuation(chart) {
  const rows = orderRows(), {note} = predicted();
  const measured = rows.some(row => known(row.attenuation));
  if (!measured && !rows.some(row => row.predicted)) {
    chart.empty(rows.length ? `no attenuation measured; ${note}` : 'nothing received yet');
    return;
  }
  const values = rows.flatMap(row => [row.attenuation, ...row.past, row.predicted?.low,
                                      row.predicted?.high]);
  chart.axes({
    x: orderAxis(chart, rows), xLabel: `order of ${find('shaft').value}`,
    y: linear(range(values, {include: [1]})), yLabel: 'attenuation (1: nothing lost)',
    title: note || channelName(channel())});
  chart.level('zero', 1);
  rows.forEach((row, i) => {
    const name = `order ${format(row.order, 6)}`, band = row.predicted;
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
      tip: `${name}: measured ${format(row.attenuation)} ± ${format(error, 2)}`});
  });
}

function drawErrors(chart) {
  const pulses = ofShaft('pulse_error');
  if (!pulses) { chart.empty('no pulse errors recovered yet (correct_jitter)'); return; }
  const declared = part('prediction')?.pulse_error_standard_deviation;
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

function drawResidual(chart) {
  const residual = part('residual'), lines = part('missing_effect')?.lines ?? [];
  if (!residual && !lines.length) {
    chart.empty('no residual received (residual_analyser)');
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
    x: places(orders.map(order => format(order, 6)), chart.inner), xLabel: 'order',
    y: linear(range([...before, ...after, ...bars], {include: [0]})),
    yLabel: 'observed − predicted'});
  chart.level('zero', 0);
  const at = order => orders.indexOf(order);
  lines.forEach((line, i) => {
    chart.mark('past', at(line.order) - 0.15, before[i], {
      tip: `${line.channel}, order ${line.order}: ${format(before[i])} with the declared model`});
    chart.mark('corrected', at(line.order) + 0.15, after[i], {square: true,
      tip: `${line.channel}, order ${line.order}: ${format(after[i])} with the traced effects`});
  });
  residual?.order.forEach((order, i) => chart.mark('measured', at(order), residual.residual[i], {
    error: known(residual.standard_error[i]) ? 2 * residual.standard_error[i] : null,
    tip: `order ${order}: ${format(residual.residual[i])} ± `
      + `${format(residual.standard_error[i], 2)}, z = ${format(residual.z[i], 3)}`}));
}

function drawSpeedLine() {
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

// --- words and tables ----------------------------------------------------------------------------

function say(id, text) { find(id).textContent = text; }

function drawTiles() {
  const orders = ofShaft('order_amplitude'), pulses = ofShaft('pulse_error');
  const header = orders?.header ?? ofShaft('synchronous_average')?.header;
  const speed = part('shaft_speed')?.value, prediction = part('prediction');
  say('speed', known(speed) ? `${format(speed, 5)} Hz` : '–');
  drawSpeedLine();
  say('average', header ? `No. ${header.sequence}` : '–');
  say('average-note', header ? `${header.trigger_cycles} trigger cycles, `
    + `${header.fundamental_cycles} revolutions of ${find('shaft').value}` : '');
  const errors = finite(pulses?.error ?? []);
  say('pulses', errors.length ? `${withTimeUnit(rms(errors))} RMS` : '–');
  const declared = prediction?.pulse_error_standard_deviation;
  say('pulses-note', (errors.length ? `${errors.length} pulses; ` : '')
    + (known(declared) ? `declared ${withTimeUnit(declared)}` : ''));
  const judged = orderRows().flatMap(({attenuation, past, predicted: row}) =>
    finite([attenuation, ...past]).filter(() => known(row?.low))
      .map(value => value >= row.low && value <= row.high));
  say('band', judged.length
    ? `${(100 * judged.filter(Boolean).length / judged.length).toFixed(0)} %` : '–');
  say('band-note', predicted().note || (judged.length
    ? `90 % expected; ${orders.history.length} averages` : ''));
  const report = part('missing_effect'), residual = part('residual');
  const [before, after] = [report?.error_before?.rms, report?.error_after?.rms];
  say('error', known(before) ? `${format(before, 2)} → ${format(after, 2)}`
    : known(residual?.rms) ? format(residual.rms, 2) : '–');
  say('error-note', known(before) ? `RMS before → after; verdict: ${report.verdict}`
    : residual ? `RMS of ${residual.acquisitions} acquisitions, chi² per degree of freedom `
      + format(residual.chi2_per_dof, 3) : '');
}

// Rows of [text, class] cells under a row of headings.
function fill(table, headings, rows) {
  const line = (tag, cells) => {
    const row = document.createElement('tr');
    for (const [text, style = ''] of cells) {
      const cell = row.appendChild(document.createElement(tag));
      cell.textContent = text;
      cell.className = style;
    }
    return row;
  };
  table.replaceChildren(line('th', headings), ...rows.map(cells => line('td', cells)));
}

function drawOrders() {
  const right = text => [text, 'number'];
  fill(find('orders'), [
    'order', `raw [${unit()}]`, 'corrected', 'noise', 'attenuation', 'predicted',
    '5 % to 95 %', 'in band'].map(right), orderRows().map(row => {
    const inside = inBand(row), band = row.predicted;
    return [...[format(row.order, 6), format(row.raw_amplitude), format(row.corrected_amplitude),
                format(row.noise_standard_deviation, 2),
                known(row.attenuation) ? `${format(row.attenuation)} ± `
                  + format(row.attenuation_standard_error, 2) : '–', format(band?.mean),
                band ? `${format(band.low)} to ${format(band.high)}` : '–'].map(right),
            [inside === null ? '–' : inside ? 'yes' : 'no',
             `number ${inside === false ? 'warn' : ''}`]];
  }));
}

function drawEffects() {
  const list = document.createElement('dl');
  for (const effect of part('missing_effect')?.missing_effects ?? []) {
    const parameters = Object.entries(effect.parameters ?? {}).map(
      ([name, {value, standard_error: error, unit: given}]) => {
        const values = [value].flat(), numbers = values.filter(item => typeof item === 'number');
        const [size, measure] = given === 's' ? timeUnit(Math.max(0, ...numbers.map(Math.abs)))
          : [1, given === '1' ? '' : given ?? ''];
        const write = (items, digits) => items.map(
          item => typeof item === 'number' ? format(item / size, digits) : item).join(', ');
        return `${name} = ${write(values, 3)}`
          + (known(error) ? ` ± ${write([error].flat(), 2)}` : '') + ` ${measure}`.trimEnd();
      });
    list.appendChild(document.createElement('dt')).textContent =
      `missing effect: ${effect.name} (${parameters.join('; ')})`;
    list.appendChild(document.createElement('dd')).textContent = (effect.evidence ?? '')
      + (effect.indistinguishable_from?.length
        ? `; cannot be told from ${effect.indistinguishable_from.join(', ')}` : '');
  }
  find('effects').replaceChildren(list);
}

function drawNodes() {
  const nodes = Object.entries(part('/diagnostics') ?? {}).sort(([a], [b]) => a < b ? -1 : 1);
  fill(find('nodes'), [['node'], ['level'], ['message'], ['lost or refused'], ['other counts'],
                       ['seen', 'number']],
       nodes.map(([name, node]) => {
    const age = state.now - node.received;
    const [style, level] = age > 5 ? LEVELS[3] : LEVELS[node.level] ?? LEVELS[3];
    const counts = Object.entries(node.values).filter(([, value]) => /^0*[1-9][0-9]*$/.test(value));
    const listed = bad => counts.filter(([key]) => LOSSES.test(key) === bad)
      .map(([key, value]) => `${key} ${value}`).join(', ') || '–';
    return [[name], [level, `level ${style}`], [node.message],
            [listed(true), listed(true) === '–' ? '' : 'warn'], [listed(false)],
            [`${age.toFixed(0)} s ago`, 'number']];
  }));
}

function drawState(failure = null) {
  const box = find('state'), silence = state.silence;
  const [style, text] = failure !== null ? ['lost', `the node live_view does not answer: ${failure}`]
    : silence === null ? ['silent', 'no data received yet']
    : silence < 3 ? ['live', 'live'] : ['silent', `no data for ${silence.toFixed(0)} s`];
  box.className = `state ${style}`;
  box.textContent = text + (state.paused ? ', display paused' : '');
}

function fillChoice(select, options) {
  if (select.options.length === options.length
      && options.every((text, i) => select.options[i].text === text)) return;
  const kept = select.value;
  select.replaceChildren(...options.map((text, i) => new Option(
    text, select.id === 'shaft' ? text : String(i))));
  if ([...select.options].some(item => item.value === kept)) select.value = kept;
  select.parentElement.hidden = options.length < 2;
}

// --- from snapshots to the page ------------------------------------------------------------------

const charts = {
  amplitudes: new Chart(find('amplitudes'), 300, drawAmplitudes),
  attenuation: new Chart(find('attenuation'), 300, drawAttenuation),
  errors: new Chart(find('errors'), 280, drawErrors),
  residual: new Chart(find('residual'), 280, drawResidual),
};
// What to draw, and when: on a change of a part whose name ends so.
const DRAWN = [
  [drawTiles, /speed|order_amplitude|pulse_error|prediction|residual|missing_effect/],
  [drawWaveforms, /average$/],
  [charts.amplitudes.render, /order_amplitude/],
  [charts.attenuation.render, /order_amplitude|prediction/],
  [drawOrders, /order_amplitude|prediction/],
  [charts.errors.render, /pulse_error|prediction/],
  [charts.residual.render, /residual|missing_effect/],
  [drawEffects, /missing_effect/],
  [drawNodes, /diagnostics/],
];

function draw(changed) {
  if (state.paused) return;
  if (changed.includes('settings')) fillChoice(find('shaft'), settings().shafts);
  const channels = ofShaft('synchronous_average')?.channels.length
    ?? ofShaft('order_amplitude')?.order.length ?? 0;
  fillChoice(find('channel'), Array.from({length: channels}, (_, i) => channelName(i)));
  for (const [action, names] of DRAWN) {
    if (changed.includes('settings') || changed.some(name => names.test(name))) action();
  }
}

const drawAll = () => draw(['settings']);

async function ask() {
  try {
    const answer = await fetch(`snapshot.json?since=${state.version}`,
                               {signal: AbortSignal.timeout(5000)});
    if (!answer.ok) throw new Error(`status ${answer.status}`);
    const news = await answer.json();
    if (state.run !== null && news.run !== state.run) {  // the node was started anew
      Object.assign(state, {run: news.run, version: 0, parts: {}});
    } else {
      Object.assign(state, {run: news.run, version: news.version, now: news.now,
                            silence: news.silence, parts: {...state.parts, ...news.parts}});
      draw(Object.keys(news.parts));
      drawState();
    }
  } catch (error) {
    drawState(error.message);
  }
  setTimeout(ask, PERIOD);
}

find('shaft').onchange = drawAll;
find('channel').onchange = drawAll;
find('pause').onclick = () => {
  state.paused = !state.paused;
  find('pause').textContent = state.paused ? 'Go on' : 'Pause';
  find('pause').setAttribute('aria-pressed', state.paused);
  drawAll();
  drawState();
};
ask();
