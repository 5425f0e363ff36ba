// Charts as SVG: axes with units, curves, marks with error bars, bands. Colours are in style.css.

const SVG = 'http://www.w3.org/2000/svg';
const MARGIN = {left: 62, right: 14, top: 24, bottom: 40};

function make(name, attributes = {}, text = null) {
  const node = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  if (text !== null) node.textContent = text;
  return node;
}

export const known = value => value !== null && value !== undefined;

// A number as text: 4 significant digits, powers of ten only where they are needed.
export function format(value, digits = 4) {
  if (!known(value)) return '–';
  const size = Math.abs(value);
  if (size !== 0 && (size < 1e-3 || size >= 1e5)) {
    const [mantissa, exponent] = value.toExponential(digits - 1).split('e');
    return `${Number(mantissa)}e${Number(exponent)}`;
  }
  return String(Number(value.toPrecision(digits)));
}

// A value with two digits of its standard error.
export function withError(value, error) {
  if (!known(value) || !known(error) || !(error > 0)) return format(value);
  const places = 1 - Number(error.toExponential(1).split('e')[1]);
  return places > 6 || Math.abs(value) >= 1e6 ? `${format(value)} ± ${format(error, 2)}`
    : `${value.toFixed(Math.max(places, 0))} ± ${error.toFixed(Math.max(places, 0))}`;
}

// Range of all known values, a little wider; never empty.
export function range(values, {margin = 0.06, include = []} = {}) {
  let low = Infinity, high = -Infinity;
  for (const value of values) {
    if (known(value)) { low = Math.min(low, value); high = Math.max(high, value); }
  }
  for (const value of include) { low = Math.min(low, value); high = Math.max(high, value); }
  if (low > high) return [0, 1];
  const room = margin * (high - low) || 0.1 * Math.abs(high) || 1;
  return [low - room, high + room];
}

// Scales: `at(value)` from 0 to 1, `ticks` as [value, label].

export function linear([first, second], count = 5) {
  const [low, high] = first < second ? [first, second] : [second, first];
  const rough = (high - low) / count, power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].find(item => item * power >= rough * 0.999) * power;
  const ticks = [];
  for (let k = Math.ceil(low / step); k * step <= high * (1 + 1e-12); ++k) ticks.push(k * step);
  const digits = Math.max(1, 1 + Math.ceil(Math.log10(
    Math.max(Math.abs(low), Math.abs(high)) / step)));
  return {at: value => (value - first) / (second - first),
          ticks: ticks.map(value => [value, format(value, digits)])};
}

export function logarithmic(values) {
  const positive = values.filter(value => known(value) && value > 0);
  let low = Math.log10(Math.min(...positive)), high = Math.log10(Math.max(...positive));
  if (!positive.length) [low, high] = [0, 1];
  const room = Math.max(0.08 * (high - low), 0.15);
  [low, high] = [low - room, high + room];
  const steps = high - low > 3 ? [1] : high - low > 1.2 ? [1, 3] : [1, 2, 3, 5, 7];
  const ticks = [];
  for (let power = Math.floor(low); power <= high; ++power) {
    for (const step of steps) {
      const value = step * 10 ** power, place = Math.log10(value);
      if (place >= low && place <= high) ticks.push([value, format(value, 1)]);
    }
  }
  return {at: value => value > 0 ? (Math.log10(value) - low) / (high - low) : -1,
          ticks: ticks.length > 2 ? ticks : linear([10 ** low, 10 ** high], 4).ticks};
}

// Places 0, 1, ... with labels, thinned out where they would touch.
export function places(labels, width) {
  const longest = Math.max(1, ...labels.map(label => label.length));
  const step = Math.max(1, Math.ceil(labels.length * (longest * 7.5 + 8) / width));
  return {at: value => (value + 0.5) / labels.length,
          ticks: labels.map((label, i) => [i, label]).filter(([i]) => i % step === 0)};
}

export class Chart {
  // `draw` is called with this chart when its size is known and whenever that changes.
  constructor(container, height, draw) {
    this.container = container;
    this.height = height;
    this.render = () => { this.width = container.clientWidth; if (this.width) draw(this); };
    new ResizeObserver(this.render).observe(container);
  }

  get inner() { return Math.max(10, this.width - MARGIN.left - MARGIN.right); }

  empty(text) {
    const note = document.createElement('p');
    note.className = 'empty';
    note.textContent = text;
    this.container.replaceChildren(note);
  }

  axes({x, y, xLabel, yLabel, title = ''}) {
    const {left, top} = MARGIN, bottom = this.height - MARGIN.bottom;
    this.svg = make('svg', {viewBox: `0 0 ${this.width} ${this.height}`, height: this.height,
                            role: 'img', 'aria-label': `${title} ${yLabel} over ${xLabel}`});
    this.x = value => left + x.at(value) * this.inner;
    this.y = value => bottom - Math.min(Math.max(y.at(value), known(value) && value > -Infinity
      ? -0.02 : 0), 1.02) * (bottom - top);
    for (const [value, label] of y.ticks) {
      const place = this.y(value);
      this.add('line', {class: 'grid', x1: left, x2: left + this.inner, y1: place, y2: place});
      this.add('text', {x: left - 6, y: place + 4, 'text-anchor': 'end'}, label);
    }
    for (const [value, label] of x.ticks) {
      const place = this.x(value);
      this.add('line', {class: 'grid', x1: place, x2: place, y1: bottom, y2: bottom + 4});
      this.add('text', {x: place, y: bottom + 17, 'text-anchor': 'middle'}, label);
    }
    this.add('text', {x: left + this.inner / 2, y: this.height - 6, 'text-anchor': 'middle'},
             xLabel);
    if (yLabel) {
      this.add('text', {transform: `translate(12 ${(top + bottom) / 2}) rotate(-90)`,
                        'text-anchor': 'middle'}, yLabel);
    }
    if (title) this.add('text', {class: 'title', x: left, y: top - 9}, title);
    this.container.replaceChildren(this.svg);
  }

  add(name, attributes, text = null, tip = '') {
    const node = make(name, attributes, text);
    if (tip) node.append(make('title', {}, tip));
    this.svg.append(node);
  }

  curve(style, xs, ys) {
    let path = '', pen = 'M';
    ys.forEach((value, i) => {
      if (!known(value)) { pen = 'M'; return; }
      path += `${pen}${this.x(xs(i)).toFixed(1)} ${this.y(value).toFixed(1)}`;
      pen = 'L';
    });
    this.add('path', {class: `curve ${style}`, d: path});
  }

  // Vertical lines from the axis to the values.
  stems(style, xs, ys) {
    const foot = this.y(-Infinity);
    this.add('path', {class: `curve ${style}`, d: ys.map((value, i) => known(value) && value > 0
      ? `M${this.x(xs(i)).toFixed(1)} ${foot.toFixed(1)}V${this.y(value).toFixed(1)}` : '').join('')});
  }

  // The circles of a polar chart: zero, and `peak` outside.
  circle({peak, label, title}) {
    const size = Math.min(this.width, this.height) / 2 - 22;
    this.svg = make('svg', {viewBox: `0 0 ${this.width} ${this.height}`, height: this.height,
                            role: 'img', 'aria-label': `${title} over the circle`});
    this.polar = (part, value) => {
      const radius = size * (0.6 + 0.4 * value / peak), angle = 2 * Math.PI * part;
      return `${(this.width / 2 + radius * Math.sin(angle)).toFixed(1)} `
        + `${(this.height / 2 + 6 - radius * Math.cos(angle)).toFixed(1)}`;
    };
    for (const [style, part] of [['grid', 0.2], ['zero', 0.6], ['grid', 1]]) {
      this.add('circle', {class: `ring ${style}`, cx: this.width / 2, cy: this.height / 2 + 6,
                          r: size * part});
    }
    for (const [part, text] of [[0, '0°'], [0.25, '90°'], [0.5, '180°'], [0.75, '270°']]) {
      const [x, y] = this.polar(part, 1.22 * peak).split(' ').map(Number);
      this.add('text', {x, y: y + 4, 'text-anchor': 'middle'}, text);
    }
    this.add('text', {class: 'title', x: 4, y: 14}, title);
    this.add('text', {x: 4, y: this.height - 4}, `zero and ± ${label}`);
    this.container.replaceChildren(this.svg);
  }

  around(style, values, peak) {
    const points = values.flatMap((value, i) => known(value)
      ? [this.polar(i / values.length, value)] : []);
    this.add('path', {class: `curve ${style}`, d: `M${points.join('L')}Z`});
  }

  // A picture that fills the axes.
  picture(address) {
    this.add('image', {href: address, x: MARGIN.left, y: MARGIN.top, width: this.inner,
                       height: this.height - MARGIN.top - MARGIN.bottom, class: 'picture',
                       preserveAspectRatio: 'none'});
  }

  // Area between two curves over the same places; nothing where one is unknown.
  between(style, xs, lows, highs) {
    const points = lows.flatMap((low, i) => known(low) && known(highs[i]) ? [i] : []);
    const place = (values, i) => `${this.x(xs(i)).toFixed(1)} ${this.y(values[i]).toFixed(1)}`;
    if (!points.length) return;
    this.add('path', {class: style, d: `M${points.map(i => place(lows, i)).join('L')}L`
      + `${points.reverse().map(i => place(highs, i)).join('L')}Z`});
  }

  // Vertical line through the axes.
  upright(style, value, tip = '') {
    const place = this.x(value);
    this.add('line', {class: style, x1: place, x2: place, y1: MARGIN.top,
                      y2: this.height - MARGIN.bottom}, null, tip);
  }

  level(style, value) {
    const place = this.y(value);
    this.add('line', {class: style, x1: MARGIN.left, x2: MARGIN.left + this.inner, y1: place,
                      y2: place});
  }

  // Horizontal line of some width around x.
  dash(style, x, value, half, tip = '') {
    if (!known(value)) return;
    const place = this.y(value);
    this.add('line', {class: style, x1: this.x(x - half), x2: this.x(x + half), y1: place,
                      y2: place}, null, tip);
  }

  band(from, to, low, high, tip = '') {
    if (!known(low) || !known(high)) return;
    const top = this.y(high);
    this.add('rect', {class: 'band', x: this.x(from), width: this.x(to) - this.x(from), y: top,
                      height: Math.max(1, this.y(low) - top)}, null, tip);
  }

  mark(style, x, value, {error = null, size = 4, square = false, tip = ''} = {}) {
    if (!known(value)) return;
    const [cx, cy] = [this.x(x), this.y(value)];
    if (known(error)) {
      this.add('line', {class: `bar ${style}`, x1: cx, x2: cx, y1: this.y(value - error),
                        y2: this.y(value + error)});
    }
    if (square) {
      this.add('path', {class: `mark ${style}`, d: `M${cx} ${cy - size - 1}l${size + 1} ${size + 1}`
        + `l${-size - 1} ${size + 1}l${-size - 1} ${-size - 1}z`}, null, tip);
    } else {
      this.add('circle', {class: `mark ${style}`, cx, cy, r: size}, null, tip);
    }
  }

  // Calls `changed(position from 0 to 1, or null)` as the pointer moves, and shows where it is: at
  // the position that `changed` returns, if it returns one. A click keeps the cursor, also while
  // new data come; the next click releases it. `kept` is in parts of an axis of length `span`.
  follow(changed, span = 1) {
    const cursor = make('line', {class: 'cursor', y1: MARGIN.top,
                                 y2: this.height - MARGIN.bottom});
    const show = () => {
      const wanted = known(this.kept) ? this.kept / span : this.pointer ?? -1;
      const inside = wanted >= 0 && wanted <= 1;
      const place = MARGIN.left + this.inner * (changed(inside ? wanted : null) ?? wanted);
      cursor.setAttribute('visibility', inside ? 'visible' : 'hidden');
      cursor.setAttribute('class', `cursor ${known(this.kept) ? 'kept' : ''}`);
      cursor.setAttribute('x1', inside ? place : 0);
      cursor.setAttribute('x2', inside ? place : 0);
    };
    const position = event => (event.clientX - this.svg.getBoundingClientRect().left
                               - MARGIN.left) / this.inner;
    this.svg.append(cursor);
    this.svg.onpointermove = event => { this.pointer = position(event); show(); };
    this.svg.onpointerleave = () => { this.pointer = null; show(); };
    this.svg.onclick = event => {
      this.kept = known(this.kept) ? null : span * position(event);
      show();
    };
    show();
  }
}
