// Values under the pointer or by arrow keys, and zoom. The page is complete without it.
(() => {
'use strict';
const make = (name, attributes, parent, text) => {
  const one = document.createElementNS((parent || document.body).namespaceURI, name);
  for (const key in attributes) one.setAttribute(key, attributes[key]);
  if (text) one.textContent = text;
  if (parent) parent.append(one);
  return one;
};
const number = (value, digits) => (digits === undefined
  ? String(Number(value.toPrecision(4))) : value.toFixed(digits)).replace('-', '\u2212');
const quantity = (value, label) => {
  const unit = (/\[(.*)\]/.exec(label) || ['', ''])[1];
  return number(value) + (unit === '' || unit === '1' ? '' : (unit[0] === '\u00b0' ? '' : ' ') + unit);
};
const tip = make('div', {class: 'tip', role: 'status', hidden: ''}, document.body);

// Both axes of a panel are worked on in units of the figure: `range` is the part that is shown.
const axis = (start, size, [low, high, kind, group, label], turned) => ({
  start, size, low, high, kind, group, label, turned,
  range: [start, start + size],
  moved(u) { return start + (u - this.range[0]) * size / (this.range[1] - this.range[0]); },
  value(u) {
    const share = (turned ? start + size - u : u - start) / size;
    return kind === 'log' ? low * (high / low) ** share : low + (high - low) * share;
  },
  place(value) {
    const share = kind === 'log' ? Math.log(value / low) / Math.log(high / low) : (value - low) / (high - low);
    return start + size * (turned ? 1 - share : share);
  },
  shows(u) { return u > this.range[0] - 0.01 && u < this.range[1] + 0.01; },
  ticks() {
    const [a, b] = this.range.map(u => this.value(u)).sort((p, q) => p - q);
    if (kind === 'log' && b > 3 * a) {
      const found = [];
      for (let k = Math.floor(Math.log10(a)); k <= Math.log10(b); k++) {
        for (const n of [1, 2, 5]) if (n * 10 ** k >= a && n * 10 ** k <= b) found.push([n * 10 ** k, number(n * 10 ** k)]);
      }
      return found;
    }
    const rough = (b - a) / (turned ? 4 : 8), power = 10 ** Math.floor(Math.log10(rough));
    const step = power * [1, 2, 5, 10].find(n => n * power >= rough);
    const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9)), found = [];
    for (let k = Math.ceil(a / step - 1e-9); k * step <= b + 1e-9 * step; k++) found.push([k * step, number(k * step, digits)]);
    return found;
  },
});
const PAIR = /(-?[\d.e-]+) (-?[\d.e-]+)/g;
const COORDINATES = ['x', 'y'];

class Panel {
  constructor(group) {
    const {box: [x, y, w, h], x: across, y: up} = JSON.parse(group.dataset.panel);
    this.axes = {x: axis(x, w, across, false), y: axis(y, h, up, true)};
    this.group = group;
    this.shapes = [...group.querySelectorAll('[clip-path], [clip-path] use, text')]
      .filter(e => !e.closest('.tick') && e.localName !== 'g')
      .filter(e => e.localName !== 'text' || e.closest('.above') || this.holds(...COORDINATES.map(c => +e.getAttribute(c))))
      .map(element => ({element, d: element.getAttribute('d'), at: COORDINATES.map(c => +element.getAttribute(c))}));
    this.ticks = [...group.querySelectorAll('.tick')].map(element => {
      const name = element.classList.contains('x') ? 'x' : 'y', mark = element.querySelector('use');
      return {element, name, at: +mark.getAttribute(name)};
    });
    this.made = [];
  }
  holds(x, y) {
    return [x, y].every((u, k) => { const a = this.axes[COORDINATES[k]]; return u >= a.start && u <= a.start + a.size; });
  }
  point(x, y) { return [this.axes.x.moved(x), this.axes.y.moved(y)]; }
  draw() {
    for (const {element, d, at} of this.shapes) {
      if (d) element.setAttribute('d', d.replace(PAIR, (_, x, y) => this.point(+x, +y).map(u => u.toFixed(2)).join(' ')));
      else {
        COORDINATES.forEach((c, k) => {
          const a = this.axes[c], inside = at[k] >= a.start && at[k] <= a.start + a.size;
          element.setAttribute(c, inside ? a.moved(at[k]) : at[k]);
        });
        if (element.localName === 'text') element.style.display = this.axes.x.shows(at[0]) ? '' : 'none';
      }
    }
    this.made.forEach(e => e.remove());
    this.made = [];
    for (const name of COORDINATES) {
      const own = this.ticks.filter(t => t.name === name), a = this.axes[name];
      const anew = a.kind !== 'fixed' && (a.range[0] !== a.start || a.range[1] !== a.start + a.size);
      for (const tick of own) {
        tick.element.style.display = anew || !a.shows(tick.at) ? 'none' : '';
        this.shift(tick.element, tick, name, a.moved(tick.at) - tick.at);
      }
      if (!anew || !own.length) continue;
      for (const [value, text] of a.ticks()) {
        const copy = own[0].element.cloneNode(true);
        copy.style.display = '';
        own[0].element.parentNode.append(copy);
        this.shift(copy, own[0], name, a.moved(a.place(value)) - own[0].at);
        const label = copy.querySelector('text');
        if (label) label.textContent = text;
        this.made.push(copy);
      }
    }
  }
  shift(element, tick, name, by) {
    tick.first = tick.first || [...tick.element.querySelectorAll('path[clip-path], use, text')]
      .map(e => [e.getAttribute('d'), +e.getAttribute(name)]);
    [...element.querySelectorAll('path[clip-path], use, text')].forEach((e, k) => {
      const [d, at] = tick.first[k];
      if (!d) e.setAttribute(name, (at + by).toFixed(2));
      else e.setAttribute('d', d.replace(PAIR, (_, x, y) => name === 'x' ? `${+x + by} ${y}` : `${x} ${+y + by}`));
    });
  }
}

class Figure {
  constructor(frame) {
    this.frame = frame;
    this.svg = frame.querySelector('svg');
    this.panels = [...this.svg.querySelectorAll('[data-panel]')].map(g => new Panel(g));
    this.texts = new Map([...this.svg.querySelectorAll('g > title')].map(t => {
      const parent = t.parentNode, text = t.textContent;
      t.remove();  // or the browser shows it a second time
      return [parent, text];
    }));
    const title = this.svg.querySelector(':scope > title');
    const defs = this.svg.insertBefore(document.createElementNS(this.svg.namespaceURI, 'defs'), title);
    defs.append(title);
    this.scale = 1;
    this.ring = make('rect', {class: 'ring', visibility: 'hidden'}, this.svg);
    this.tools();
    this.listen();
  }
  // What can be pointed at: middle and half sizes in units of the figure, and its text.
  targets() {
    if (this.known) return this.known;
    const found = [];
    for (const panel of this.panels) {
      for (const group of panel.group.querySelectorAll('g')) {
        const tips = group.dataset.tips && group.dataset.tips.split('\n');
        if (!tips && !this.texts.has(group)) continue;
        const line = group.querySelector(':scope > path');
        const points = line ? [...line.getAttribute('d').matchAll(PAIR)].map(m => [+m[1], +m[2]])
          : [...group.querySelectorAll('use')].map(u => COORDINATES.map(c => +u.getAttribute(c)));
        const first = panel.shapes.find(s => s.element === line || group.contains(s.element));
        const own = line ? [...first.d.matchAll(PAIR)].map(m => [+m[1], +m[2]]) : [first.at];
        points.forEach(([x, y], k) => {
          if (!panel.holds(x, y)) return;
          const {x: across, y: up} = panel.axes;
          const text = tips ? tips[k] : !line ? this.texts.get(group)
            : `${this.texts.get(group)}: ${quantity(up.value(own[k][1]), up.label)} at ${quantity(across.value(own[k][0]), across.label)}`;
          found.push({x, y, w: 0, h: 0, text, panel});
        });
      }
    }
    if (!this.panels.length) {
      for (const [group, text] of this.texts) {
        const box = group.querySelector('rect').getBBox();
        found.push({x: box.x + box.width / 2, y: box.y + box.height / 2, w: box.width / 2, h: box.height / 2, text});
      }
    }
    if (this.svg.dataset.map) found.push(...cells(JSON.parse(this.svg.dataset.map)));
    return this.known = found;
  }
  unit() { return this.svg.getScreenCTM().a; }
  at(event) {
    const point = new DOMPoint(event.clientX, event.clientY).matrixTransform(this.svg.getScreenCTM().inverse());
    return [point.x, point.y];
  }
  nearest([x, y]) {
    const panel = this.panels.find(p => p.holds(x, y));
    let best, least = (24 / this.unit()) ** 2;
    for (const one of this.targets()) {
      if (one.panel !== panel) continue;
      const away = Math.max(0, Math.abs(x - one.x) - one.w) ** 2 + Math.max(0, Math.abs(y - one.y) - one.h) ** 2;
      if (away < least) [best, least] = [one, away];
    }
    return best;
  }
  show(one, byKey) {
    this.shown = one;
    this.ring.setAttribute('visibility', one ? 'visible' : 'hidden');
    tip.hidden = !one;
    if (!one) return;
    const w = one.w || 4 / this.unit(), h = one.h || w;
    const sizes = {x: one.x - w, y: one.y - h, width: 2 * w, height: 2 * h, rx: one.w ? 0 : w};
    for (const key in sizes) this.ring.setAttribute(key, sizes[key]);
    if (byKey) this.ring.scrollIntoView({block: 'nearest', inline: 'nearest'});
    tip.setAttribute('aria-live', byKey ? 'polite' : 'off');
    tip.textContent = one.text;
    const place = this.ring.getBoundingClientRect(), width = document.documentElement.clientWidth;
    const left = Math.min(Math.max(4, (place.left + place.right - tip.offsetWidth) / 2), width - tip.offsetWidth - 4);
    const above = place.top - tip.offsetHeight - 6;
    tip.style.left = `${left + scrollX}px`;
    tip.style.top = `${(above > 0 ? above : place.bottom + 6) + scrollY}px`;
  }
  step(by) {
    const all = this.targets(), now = all.indexOf(this.shown);
    if (all.length) this.show(all[now < 0 ? (by > 0 ? 0 : all.length - 1) : (now + by + all.length) % all.length], true);
  }
  redraw() {
    this.known = undefined;
    this.show();
    this.panels.forEach(p => p.draw());
  }
  // Sets the range of an axis of a panel and of those that share it.
  set(panel, name, low, high) {
    const a = panel.axes[name], size = Math.min(Math.max(high - low, a.size / 500), a.size);
    const start = Math.min(Math.max(low, a.start), a.start + a.size - size);
    const share = [start, start + size].map(u => (u - a.start) / a.size);
    for (const {axes} of this.panels) {
      const other = axes[name];
      if (other.group === a.group) other.range = share.map(s => other.start + s * other.size);
    }
  }
  zoom(factor) {
    if (!this.panels.length) {
      this.scale = Math.min(Math.max(this.scale * factor, 1), 8);
      const zoomed = this.scale > 1;
      this.svg.style.maxWidth = zoomed ? 'none' : '';
      this.svg.style.width = zoomed ? `${100 * this.scale}%` : '';
      return this.show();
    }
    const done = new Set(), focus = this.shown;
    for (const panel of this.panels) {
      for (const name of focus ? COORDINATES : ['x']) {
        const a = panel.axes[name], key = name + a.group;
        if (done.has(key) || (name === 'y' && focus.panel !== panel)) continue;
        done.add(key);
        const [low, high] = a.range;
        const middle = focus && (name === 'x' || focus.panel === panel)
          ? low + (focus[name] - a.start) * (high - low) / a.size : (low + high) / 2;
        this.set(panel, name, middle - (middle - low) / factor, middle + (high - middle) / factor);
      }
    }
    this.redraw();
    if (focus) this.show(this.targets().find(t => t.text === focus.text && t.panel === focus.panel), true);
  }
  pan(by) {
    const done = new Set();
    for (const panel of this.panels) {
      const a = panel.axes.x, size = a.range[1] - a.range[0];
      if (!done.has(a.group)) this.set(panel, 'x', a.range[0] + by * size, a.range[1] + by * size);
      done.add(a.group);
    }
    this.redraw();
  }
  reset() {
    for (const {axes} of this.panels) for (const name of COORDINATES) axes[name].range = [axes[name].start, axes[name].start + axes[name].size];
    if (this.panels.length) this.redraw();
    else this.zoom(1 / this.scale);
  }
  tools() {
    const label = this.frame.getAttribute('aria-label');
    const bar = make('div', {class: 'tools', role: 'group', 'aria-label': `Zoom of ${label}`});
    this.frame.before(bar);
    for (const [text, name, action] of [
      ['+', 'Zoom in', () => this.zoom(1.6)],
      ['\u2212', 'Zoom out', () => this.zoom(1 / 1.6)],
      ['Reset', 'Reset the zoom', () => this.reset()],
    ]) make('button', {type: 'button', 'aria-label': `${name}, ${label}`, title: name}, bar, text).addEventListener('click', action);
    const drag = this.panels.length ? 'drag: zoom; double click: reset; ' : '';
    bar.title = `point: value; ${drag}keys: arrows, +, \u2212, 0`;
    if (!document.querySelector('.tools span')) make('span', {}, bar, bar.title);
  }
  listen() {
    const {svg, frame} = this;
    let from;
    svg.addEventListener('pointermove', event => {
      const to = this.at(event);
      if (!from) return this.show(this.nearest(to));
      const box = COORDINATES.map((_, k) => [from[k], to[k]].sort((a, b) => a - b));
      const sizes = {x: box[0][0], y: box[1][0], width: box[0][1] - box[0][0], height: box[1][1] - box[1][0], rx: 0, visibility: 'visible'};
      for (const key in sizes) this.ring.setAttribute(key, sizes[key]);
    });
    svg.addEventListener('pointerleave', () => from || this.show());
    svg.addEventListener('click', event => this.show(this.nearest(this.at(event))));
    svg.addEventListener('pointerdown', event => {
      const start = this.at(event);
      if (event.pointerType === 'touch' || event.button || !this.panels.some(p => p.holds(...start))) return;
      from = start;
      this.show();
      svg.setPointerCapture(event.pointerId);
      event.preventDefault();
    });
    svg.addEventListener('pointerup', event => {
      if (!from) return;
      const to = this.at(event), panel = this.panels.find(p => p.holds(...from)), start = from;
      from = undefined;
      this.ring.setAttribute('visibility', 'hidden');
      let changed = false;
      COORDINATES.forEach((name, k) => {
        if (Math.abs(to[k] - start[k]) * this.unit() < 8) return;
        const a = panel.axes[name], [low, high] = a.range;
        const range = [start[k], to[k]].sort((p, q) => p - q).map(u => low + (u - a.start) * (high - low) / a.size);
        this.set(panel, name, ...range);
        changed = true;
      });
      if (changed) this.redraw();
    });
    svg.addEventListener('pointercancel', () => { from = undefined; this.show(); });
    svg.addEventListener('dblclick', () => this.reset());
    frame.addEventListener('blur', () => this.show());
    frame.addEventListener('keydown', event => {
      if (event.ctrlKey || event.metaKey || event.altKey || event.target !== frame) return;
      const actions = {
        ArrowRight: () => event.shiftKey ? this.pan(0.2) : this.step(1),
        ArrowLeft: () => event.shiftKey ? this.pan(-0.2) : this.step(-1),
        '+': () => this.zoom(1.6), '=': () => this.zoom(1.6), '-': () => this.zoom(1 / 1.6),
        0: () => this.reset(), Escape: () => this.show(),
      };
      if (!actions[event.key]) return;
      actions[event.key]();
      event.preventDefault();
    });
  }
}
const cells = ({left, top, side, edges, times, names, values, label}) => values.flatMap((row, i) => row.map((value, j) => ({
  x: (edges[j] + edges[j + 1]) / 2, w: (edges[j + 1] - edges[j]) / 2,
  y: top + side * (i + 0.5), h: side / 2,
  text: `${names[i]}, ${number(times[j], 2)} to ${number(times[j + 1], 2)} s: ` +
    (value === null ? 'missing' : `${label} ${String(value).replace('-', '\u2212')}`),
})));
for (const frame of document.querySelectorAll('figure .wide')) if (frame.querySelector('svg')) new Figure(frame);
})();
