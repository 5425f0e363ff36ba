// The numbers and tables of the page.

import {format, known, withError} from './charts.js';
import {drawSpeedLine} from './drawings.js';
import {analysed, changes, changeText, channelName, find, finite, inBand, nameOf, ofShaft, orderRows, part,
        predicted, prediction, state, timeUnit, unit, unitOf, withTimeUnit, words} from './model.js';

const LEVELS = [['ok', 'OK'], ['warn', 'WARN'], ['error', 'ERROR'], ['error', 'STALE']];
const MOST_CHANGES = 5;
const LOSSES = /dropped|gaps|restarts|clock_deviation|rejected|refused/;

const rms = values => Math.sqrt(values.reduce((sum, x) => sum + x * x, 0) / values.length);
function show(id, text) { find(id).textContent = text; }

// How long ago the last average of the shown shaft came, '' while they come as often as before.
function silence() {
  const last = state.parts[`${find('shaft').value}/order_amplitude`];
  const header = last?.content.header, age = last ? state.now - last.received : 0;
  return header && age > 5 + 2 * (header.end_time - header.start_time)
    ? `; none for ${age.toFixed(0)} s` : '';
}

export function drawTiles() {
  const orders = ofShaft('order_amplitude'), pulses = ofShaft('pulse_error');
  const header = orders?.header ?? ofShaft('synchronous_average')?.header;
  const speed = part('shaft_speed')?.value;
  show('speed', known(speed) ? `${format(speed, 5)} Hz` : '–');
  drawSpeedLine();
  show('average', header ? `No. ${header.sequence}` : '–');
  show('average-note', header ? `${header.trigger_cycles} trigger cycles, `
    + `${header.fundamental_cycles} revolutions of ${find('shaft').value}${silence()}` : '');
  const errors = finite(pulses?.error ?? []);
  show('pulses', errors.length ? `${withTimeUnit(rms(errors))} RMS` : '–');
  const declared = prediction()?.pulse_error_standard_deviation;
  show('pulses-note', (errors.length ? `${errors.length} pulses; ` : '')
    + (known(declared) ? `declared ${withTimeUnit(declared)}` : ''));
  const comparisons = orderRows().flatMap(({attenuation, past, predicted: row}) =>
    finite([attenuation, ...past]).filter(() => known(row?.low))
      .map(value => value >= row.low && value <= row.high));
  show('band', comparisons.length
    ? `${(100 * comparisons.filter(Boolean).length / comparisons.length).toFixed(0)} %` : '–');
  show('band-note', predicted().note || (comparisons.length
    ? `90 % expected; ${orders.history.length} averages` : ''));
  const report = analysed('missing_effect').content, residual = analysed('residual').content;
  const [before, after] = [report?.error_before?.rms, report?.error_after?.rms];
  show('error', known(before) ? `${format(before, 2)} → ${format(after, 2)}`
    : known(residual?.rms) ? format(residual.rms, 2) : '–');
  show('error-note', known(before) ? `RMS before → after; verdict: ${report.verdict}`
    : residual ? `RMS of ${residual.acquisitions} acquisitions, chi² per degree of freedom `
      + format(residual.chi2_per_dof, 3) : '');
}

export function drawChange() {
  const found = part('change'), baseline = found?.baseline;
  find('change-tile').hidden = !found;
  if (!found) return;
  show('change', baseline && !baseline.complete ? 'learning' : changes().length || 'none');
  show('change-note', baseline ? `baseline of ${baseline.averages} averages` : '');
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

export function drawOrders() {
  const right = text => [text, 'number'];
  fill(find('orders'), [
    'order', `raw [${unit()}]`, `corrected [${unit()}]`, `noise [${unit()}]`, 'attenuation',
    'predicted', '5 % to 95 %', 'in band'].map(right), orderRows().map(row => {
    const inside = inBand(row), band = row.predicted;
    return [...[nameOf(row.order) ? words(row.order) : format(row.order, 6),
                withError(row.raw_amplitude, row.raw_standard_error),
                withError(row.corrected_amplitude, row.corrected_standard_error),
                format(row.noise_standard_deviation, 2),
                withError(row.attenuation, row.attenuation_standard_error), format(band?.mean),
                band ? `${format(band.low)} to ${format(band.high)}` : '–'].map(right),
            [inside === null ? '–' : inside ? 'yes' : 'no',
             `number ${inside === false ? 'warn' : ''}`]];
  }));
}

// {names, values, errors} of the last average; errors are null until they come.
function indicators() {
  const found = ofShaft('condition_indicator'), error = ofShaft('condition_indicator_error');
  return found && {...found, errors: error?.header.sequence === found.header.sequence
    ? error.values : null};
}

const indicatorName = name => name.replaceAll('_', ' ') + (unitOf(name) && ` [${unitOf(name)}]`);

export function drawIndicators() {
  const found = indicators();
  if (!found) {
    fill(find('indicators'), [['none received yet']], []);
    return;
  }
  fill(find('indicators'), [['channel'], ...found.names.map(
    name => [indicatorName(name), 'number'])],
       found.values.map((row, i) => [[channelName(i)], ...row.map(
         (value, k) => [withError(value, found.errors?.[i]?.[k]), 'number'])]));
}

export function indicatorsTable() {
  const found = indicators();
  return found && {
    columns: ['channel', ...found.names.flatMap(
      name => [indicatorName(name), `standard error of ${indicatorName(name)}`])],
    rows: found.values.map((row, i) => [channelName(i), ...row.flatMap(
      (value, k) => [value, found.errors?.[i]?.[k] ?? null])])};
}

export function drawEffects() {
  const list = document.createElement('dl');
  for (const effect of analysed('missing_effect').content?.missing_effects ?? []) {
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
        ? `; not distinguishable from ${effect.indistinguishable_from.join(', ')}` : '');
  }
  find('effects').replaceChildren(list);
}

// What has changed, and how: of a limit its value and bound.
const quantityOf = item => item.kind === 'indicator' ? item.name.replaceAll('_', ' ')
  : item.kind === 'limit' || known(item.order) ? item.name
    : `${item.kind === 'bearing' ? 'bearing ' : ''}order ${item.name}`;
const findingOf = item => item.kind === 'limit' ? `${withError(item.value, item.value_error)} above `
  + `${format(item.limit)} (${item.level})` : changeText(item);

// Above everything: what has changed, and which nodes lack something, with their own words.
export function drawAttention() {
  // What the monitor says of changes stands there already.
  const said = node => changes().length && 'baseline_complete' in node.values
    && node.message.includes('since average');
  const bad = Object.entries(part('/diagnostics') ?? {}).filter(([, node]) => !said(node)).map(([name, node]) => {
    const age = state.now - node.received;
    return [age > 5 ? 3 : node.level, name, age > 5 ? `no status for ${age.toFixed(0)} s`
      : node.message];
  }).filter(([level]) => level > 0).sort(([a], [b]) => b - a);
  const changed = [...changes()].sort((a, b) => (a.p_value ?? 0) - (b.p_value ?? 0)).map(
    item => [item.level === 'alarm' ? 2 : 1, quantityOf(item),
             `of ${item.shaft}, ${channelName(item.channel)}: ${findingOf(item)} since average `
             + item.since_sequence + (known(item.keyphasor_share) ? '; the keyphasor explains '
               + `${format(100 * item.keyphasor_share, 2)} %` : '')]);
  const lines = [...changed.slice(0, MOST_CHANGES).map(
    ([level, name, text]) => [level, `${name} ${text}`]),
                 ...(changed.length > MOST_CHANGES
                   ? [[1, `and ${changed.length - MOST_CHANGES} more changes`]] : []),
                 ...bad.map(([level, name, text]) => [level, `${name}: ${text}`])];
  find('attention').replaceChildren(...lines.map(([level, text]) => {
    const line = document.createElement('p');
    line.className = (LEVELS[level] ?? LEVELS[3])[0];
    line.textContent = text;
    return line;
  }));
}

export function drawNodes() {
  const nodes = Object.entries(part('/diagnostics') ?? {}).sort(([a], [b]) => a < b ? -1 : 1);
  fill(find('nodes'), [['node'], ['level'], ['message'], ['dropped or refused'], ['other counts'],
                       ['last status', 'number']],
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
