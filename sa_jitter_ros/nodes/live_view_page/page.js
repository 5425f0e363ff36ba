// The page: gets new data twice a second and draws it.

import {Chart} from './charts.js';
import {drawAmplitudes, drawAttenuation, drawErrors, drawResidual, drawWaveforms, errorsTable,
        ordersTable, residualTable, waveformTable} from './drawings.js';
import {addButtons} from './export.js';
import {channel, channelName, find, ofShaft, settings, state} from './model.js';
import {drawMap, drawPolar, drawSpectrum, drawTrends, keepOrder, mapTable, spectrumTable,
        trendTable} from './panels.js';
import {drawAttention, drawChange, drawEffects, drawIndicators, drawNodes, drawOrders, drawTiles,
        indicatorsTable} from './words.js';

const PERIOD = 500;  // ms between requests

function drawState(failure = null) {
  const box = find('state'), silence = state.silence;
  const [style, text] = state.paused ? ['silent', 'paused']
    : failure !== null ? ['lost', `the node live_view does not answer: ${failure}`]
    : silence === null ? ['silent', 'no data received yet']
    : silence < 3 ? ['live', 'live'] : ['silent', `no data for ${silence.toFixed(0)} s`];
  box.className = `state ${style}`;
  box.textContent = text;
}

function fillChoice(select, options) {
  if (select.options.length === options.length
      && options.every((text, i) => select.options[i].text === text)) return;
  const before = select.value;
  select.replaceChildren(...options.map((text, i) => new Option(
    text, select.id === 'shaft' ? text : String(i))));
  if ([...select.options].some(item => item.value === before)) select.value = before;
  select.parentElement.hidden = options.length < 2;
}

// --- from snapshots to the page ------------------------------------------------------------------

const charts = {
  amplitudes: new Chart(find('amplitudes'), 300, drawAmplitudes),
  attenuation: new Chart(find('attenuation'), 300, drawAttenuation),
  errors: new Chart(find('errors'), 280, drawErrors),
  residual: new Chart(find('residual'), 280, drawResidual),
  spectrum: new Chart(find('spectrum'), 280, drawSpectrum),
  map: new Chart(find('map'), 280, drawMap),
  polar: new Chart(find('polar'), 280, drawPolar),
};
const TABLES = {waveforms: waveformTable, polar: waveformTable, spectrum: spectrumTable, map: mapTable,
                amplitudes: ordersTable, attenuation: ordersTable, trend: trendTable,
                errors: errorsTable, residual: residualTable, orders: ordersTable,
                indicators: indicatorsTable};
for (const [name, table] of Object.entries(TABLES)) {
  const average = () => ofShaft('synchronous_average')?.header.sequence ?? 0;
  const box = find(name), pictures = box.tagName !== 'TABLE';
  addButtons(pictures ? box : box.parentElement, table, () => [
    find('shaft').value, name, channelName(channel()), average()].join('-').replaceAll(
    /[^\w.-]+/g, '_'), {pictures});
}

// What to draw when a part changes whose name matches.
const DRAWN = [
  [drawTiles, /speed|order_amplitude|pulse_error|prediction|residual|missing_effect/],
  [drawWaveforms, /average$|standard_error/],
  [charts.polar.render, /average$/],
  [charts.spectrum.render, /_spectrum$/],
  [charts.map.render, /_map$/],
  [drawTrends, /_trend$|^change$/],
  [drawChange, /^change$/],
  [charts.amplitudes.render, /order_amplitude/],
  [charts.attenuation.render, /order_amplitude|prediction/],
  [drawOrders, /order_amplitude|prediction/],
  [drawIndicators, /condition_indicator/],
  [charts.errors.render, /pulse_error|prediction/],
  [charts.residual.render, /residual|missing_effect/],
  [drawEffects, /missing_effect/],
  [drawNodes, /diagnostics/],
  [drawAttention, /diagnostics|^change$/],
];

function draw(changed) {
  if (changed.includes('settings')) fillChoice(find('shaft'), settings().shafts);
  const channels = ofShaft('synchronous_average')?.channels.length
    ?? ofShaft('order_amplitude')?.order.length ?? 0;
  fillChoice(find('channel'), Array.from({length: channels}, (_, i) => channelName(i)));
  for (const [action, names] of DRAWN) {
    if (!changed.includes('settings') && !changed.some(name => names.test(name))) continue;
    try {
      action();
    } catch (error) {  // a malformed report must not hide the rest
      console.error(error);
    }
  }
}

const drawAll = () => draw(['settings']);

async function ask() {
  try {
    const answer = await fetch(`snapshot.json?since=${state.version}&channel=${channel()}`,
                               {signal: AbortSignal.timeout(5000)});
    if (!answer.ok) throw new Error(`status ${answer.status}`);
    const news = await answer.json();
    if (state.run !== null && news.run !== state.run) {  // the node was restarted
      Object.assign(state, {run: news.run, version: 0, parts: {}});
      return;
    }
    Object.assign(state, {run: news.run, version: news.version, now: news.now,
                          silence: news.silence, parts: {...state.parts, ...news.parts}});
    draw(Object.keys(news.parts));
    drawTiles();  // and the states of nodes, which change while nothing comes
    drawNodes();
    drawAttention();
    drawState();
  } catch (error) {
    drawState(error.message);
  }
}

async function go() {
  if (!state.paused) await ask();
  setTimeout(go, PERIOD);
}

find('spectrum-order').oninput = () => keepOrder(charts.spectrum);
find('shaft').onchange = drawAll;
find('channel').onchange = () => {
  state.version = 0;  // spectra and trends are sent for one channel
  drawAll();
  if (!state.paused) ask();
};
find('pause').onclick = () => {
  state.paused = !state.paused;
  find('pause').textContent = state.paused ? 'Continue' : 'Pause';
  find('pause').setAttribute('aria-pressed', state.paused);
  drawState();
};
go();
