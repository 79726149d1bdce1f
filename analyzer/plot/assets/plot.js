// Draws a recording along its time on a canvas, zooms it, and tells the values at one time. Text goes
// in as text only: nothing here writes markup.
"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const canvas = document.getElementById("plot");
  const overview = document.getElementById("map");
  const tools = document.getElementById("tools");
  const readout = document.getElementById("readout");
  const told = Object.fromEntries(
    [...readout.querySelectorAll("dd")].map((cell) => [cell.dataset.of, cell]),
  );
  const listed = [...document.querySelectorAll("#anomalies tbody tr")];
  const FINEST = 1000; // ns that can be seen at the least
  const NEAR = 8; // px from an anomaly to the line at which it is told
  const LEFT = 98, AXIS = 26, GAP = 14, MAP = 40;
  const ROW = 15; // px of a motion's row
  const WORD = data.word ? [{ name: data.word, height: ROW * data.motions.length, draw: drawMotion }] : [];
  const RANGES = Object.keys(data.bounds);
  const LANES = [
    ...WORD,
    ...RANGES.map((name) => ({ name, height: 96, draw: drawRange })),
    { name: "anomalies", height: 42, draw: drawMarks },
    { name: "latency", height: 120, draw: drawLatencies },
  ];

  // -- the recording ------------------------------------------------------------------------------

  function times(deltas) {
    let t = 0;
    return deltas.map((delta) => (t += delta));
  }

  const begin = data.begin;
  const end = Math.max(data.end, begin + FINEST);
  const states = { ...data.states, t: times(data.states.t) };
  const latencies = { ...data.latencies, t: times(data.latencies.t) };
  latencies.high ??= latencies.low;
  const marks = { ...data.marks, t: times(data.marks.t) };

  // -- the axis ------------------------------------------------------------------------------------

  // A place on the axis is a time (ns) of which every fold before it has taken away most of its length.
  const rest = data.folds.reduce((left, [from, to]) => left - (to - from), end - begin);
  const FOLD = Math.max(rest, FINEST) / 30; // the length of a fold on the axis
  const pieces = []; // each has the same scale from one end to the other
  for (const [from, to, idle] of [...data.folds, [end, end, ""]]) {
    const last = pieces.at(-1) ?? { to: begin, until: begin };
    const since = last.until + (from - last.to);
    pieces.push({ from: last.to, to: from, since: last.until, until: since, idle: "" });
    if (idle) pieces.push({ from, to, since, until: since + FOLD, idle });
  }
  const LAST = pieces.at(-1).until; // the place of the recording's end; that of its begin is `begin`

  /** Where a time is on the axis. */
  function along(t) {
    const one = pieces.find((piece) => t <= piece.to) ?? pieces.at(-1);
    const scale = (one.until - one.since) / (one.to - one.from || 1);
    return one.since + (Math.max(t, begin) - one.from) * scale;
  }

  /** The time at a place of the axis. */
  function timeOf(place) {
    const one = pieces.find((piece) => place <= piece.until) ?? pieces.at(-1);
    const scale = (one.to - one.from) / (one.until - one.since || 1);
    return Math.min(one.from + Math.max(0, place - one.since) * scale, one.to);
  }

  /** The place of the last time that is not after `t`, -1 if all are. */
  function placeOf(t, list) {
    let low = 0, high = list.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (list[middle] <= t) low = middle + 1;
      else high = middle;
    }
    return low - 1;
  }

  function seen(row) {
    return states.seen ? states.seen[row] : 1 << states.motion[row];
  }

  /** The lowest and the highest value of a variable in a row. */
  function range(name, row) {
    const { last, low, high } = states[name];
    return low ? [low[row], high[row]] : [last[row], last[row]];
  }

  // -- words ---------------------------------------------------------------------------------------

  function duration(ns) {
    const size = Math.abs(ns);
    if (size >= 1e9) return `${+(ns / 1e9).toPrecision(4)} s`;
    if (size >= 1e6) return `${+(ns / 1e6).toPrecision(4)} ms`;
    return `${+(ns / 1e3).toPrecision(4)} µs`;
  }

  /** A time, with as many digits as a step of so many ns needs. */
  function clock(t, step) {
    const digits = Math.min(9, Math.max(0, Math.ceil(-Math.log10(step / 1e9) - 1e-9)));
    if (step < 1e9 || Math.abs(t) < 120e9) return `${(t / 1e9).toFixed(digits)} s`;
    const whole = Math.round(t / 1e9);
    const parts = [Math.floor(whole / 3600), Math.floor(whole / 60) % 60, whole % 60];
    const words = parts.map((part) => String(part).padStart(2, "0"));
    return (whole >= 3600 ? words : words.slice(1)).join(":");
  }

  function motions(bits) {
    const names = data.motions.filter((_, place) => (bits >> (2 * place)) & 3);
    const still = data.motions.some((name, place) => place && (bits >> (2 * place)) & 1);
    const turning = data.motions.some((_, place) => (bits >> (2 * place)) & 2);
    return names.join(", ") + (still && !turning ? " (speed 0: not moving)" : "");
  }

  function between([low, high], words = String) {
    return low === high ? words(low) : `${words(low)} to ${words(high)}`;
  }

  // -- the view ------------------------------------------------------------------------------------

  let view = [begin, LAST]; // places on the axis
  let cursor = null;
  let due = 0;
  const context = canvas.getContext("2d");
  const calm = overview.getContext("2d");
  let width = 0, gutter = LEFT, colours = {};

  function redraw() {
    due ||= requestAnimationFrame(() => {
      due = 0;
      draw();
    });
  }

  function show(from, to) {
    const least = Math.min(FINEST, LAST - begin);
    const span = Math.min(Math.max(to - from, least), LAST - begin);
    const middle = (from + to) / 2;
    const first = Math.min(Math.max(middle - span / 2, begin), LAST - span);
    const changed = view[0] !== first || view[1] !== first + span;
    view = [first, first + span];
    redraw();
    return changed;
  }

  function zoom(factor, t = cursor ?? timeOf((view[0] + view[1]) / 2)) {
    const held = along(t);
    return show(held - (held - view[0]) * factor, held + (view[1] - held) * factor);
  }

  function move(share) {
    const by = (view[1] - view[0]) * share;
    const [from, to] = view;
    const held = Math.min(Math.max(by, begin - from), LAST - to);
    return show(from + held, to + held);
  }

  function x(t) {
    return gutter + ((along(t) - view[0]) / (view[1] - view[0])) * (width - gutter);
  }

  function timeAt(px) {
    const share = (px - gutter) / (width - gutter);
    return timeOf(view[0] + Math.min(Math.max(share, 0), 1) * (view[1] - view[0]));
  }

  /** The times at the view's ends. */
  function shown() {
    return view.map(timeOf);
  }

  function aim(t) {
    cursor = Math.min(Math.max(t, begin), end);
    tell();
    redraw();
  }

  // -- what is told at the line ----------------------------------------------------------------------

  function tell() {
    const px = (view[1] - view[0]) / Math.max(1, width - gutter);
    told.time.textContent = clock(cursor, px);
    const row = Math.max(0, placeOf(cursor, states.t));
    const some = states.t.length > 0;
    for (const { name } of WORD) told[name].textContent = some ? motions(seen(row)) : "none";
    for (const name of RANGES) told[name].textContent = some ? between(range(name, row)) : "none";
    const answer = placeOf(cursor, latencies.t);
    told.latency.textContent =
      answer < 0 ? "none yet" : between([latencies.low[answer], latencies.high[answer]], duration);
    const mark = nearest(cursor, NEAR * px);
    told.anomaly.classList.toggle("odd", mark >= 0);
    told.anomaly.textContent = mark < 0 ? "none here" : words(mark);
  }

  function words(mark) {
    const [time, kind, reason] = [...listed[mark].cells].map((cell) => cell.textContent);
    return `${kind} at ${time}: ${reason}`;
  }

  /** The mark nearest to a time and at most so many ns away, -1 if there is none. */
  function nearest(t, most) {
    const before = placeOf(t, marks.t);
    const near = [before, before + 1].filter((place) => Math.abs(marks.t[place] - t) <= most);
    near.sort((one, other) => Math.abs(marks.t[one] - t) - Math.abs(marks.t[other] - t));
    return near.length ? near[0] : -1;
  }

  /** Move the line to the next anomaly (or with -1 to the previous), and the view along with it. */
  function step(way) {
    const from = cursor ?? shown()[0];
    let place = placeOf(from, marks.t);
    if (way > 0) place += 1;
    else if (marks.t[place] === from) place -= 1;
    if (place >= 0 && place < marks.t.length) goTo(marks.t[place]);
  }

  function goTo(t) {
    const [[from, to], middle] = [view, along(t)];
    const half = (to - from) / 2;
    if (middle < from || middle > to) show(middle - half, middle + half);
    aim(t);
  }

  // -- drawing -------------------------------------------------------------------------------------

  function fit(target, pen, height) {
    const ratio = window.devicePixelRatio || 1;
    width = target.clientWidth;
    target.style.height = `${height}px`;
    if (target.width !== Math.round(width * ratio) || target.height !== Math.round(height * ratio)) {
      target.width = Math.round(width * ratio);
      target.height = Math.round(height * ratio);
    }
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.font = `12px ${colours.font}`;
    pen.textBaseline = "middle";
  }

  function takeColours() {
    const style = getComputedStyle(document.documentElement);
    const names = ["ink", "dim", "line", "raised", "paper", "host", "device", "fail-bar"];
    names.push("accent", "skipped-soft", "non-strict-bar");
    colours = Object.fromEntries(names.map((name) => [name, style.getPropertyValue(`--${name}`)]));
    colours.font = getComputedStyle(document.body).fontFamily;
  }

  function draw() {
    takeColours();
    const narrow = canvas.clientWidth < 560;
    gutter = narrow ? 0 : LEFT;
    const heading = narrow ? 18 : 0; // a lane's name stands above it where there is no room beside
    const height = LANES.reduce((sum, lane) => sum + heading + lane.height + GAP, AXIS);
    fit(canvas, context, height);
    const bottom = height - AXIS;
    grid(bottom);
    let top = 0;
    const words = []; // drawn last, above the folds
    for (const lane of LANES) {
      top += heading;
      const above = narrow ? top - 9 : top + 7;
      words.push(() => name(lane.name, above));
      context.strokeStyle = colours.line;
      context.strokeRect(gutter + 0.5, top + 0.5, width - gutter - 1, lane.height);
      context.save();
      context.beginPath();
      context.rect(gutter, top, width - gutter, lane.height + 1);
      context.clip();
      const labels = lane.draw(lane, top);
      context.restore();
      words.push(() => labels?.(narrow));
      top += lane.height + GAP;
    }
    drawFolds(bottom);
    for (const write of words) write();
    const [from, to] = shown();
    if (cursor !== null && cursor >= from && cursor <= to) {
      context.fillStyle = colours.ink;
      context.fillRect(Math.round(x(cursor)), 0, 1, bottom);
    }
    drawMap();
    tools.querySelector('[data-do="all"]').disabled = view[0] === begin && view[1] === LAST;
  }

  function name(lane, y) {
    context.fillStyle = colours.ink;
    context.textAlign = "left";
    context.fillText(lane, 0, y);
  }

  /** Round times in the view: those that are a multiple of 1, 2 or 5 times a power of ten. */
  function ticks(most) {
    const least = (view[1] - view[0]) / most;
    const power = 10 ** Math.floor(Math.log10(least));
    let size = [1, 2, 5, 10].map((times) => times * power).find((one) => one >= least);
    const clocks = [15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 21600, 86400];
    if (size > 10e9) size = clocks.map((s) => s * 1e9).find((one) => one >= least) ?? size;
    const [first, last] = shown();
    const found = [];
    for (const { from, to, idle } of pieces) {
      if (idle || to < first || from > last) continue;
      const before = found.length;
      const start = Math.max(from, first);
      for (let t = Math.ceil(start / size) * size; t <= Math.min(to, last); t += size) found.push(t);
      if (found.length === before) found.push(start); // what stands between two folds has a time too
    }
    return [found, size];
  }

  function grid(bottom) {
    const [found, size] = ticks(Math.max(2, (width - gutter) / 110));
    context.textAlign = "center";
    let free = gutter;
    for (const t of found) {
      const at = Math.round(x(t));
      context.fillStyle = colours.line;
      context.fillRect(at, 0, 1, bottom);
      const word = clock(t, size);
      const half = context.measureText(word).width / 2;
      const middle = Math.min(Math.max(at, gutter + half), width - half);
      if (middle - half < free) continue;
      free = middle + half + 6;
      context.fillStyle = colours.dim;
      context.fillText(word, middle, bottom + 12);
    }
  }

  /** Break marks where time is folded: two jagged edges and how long nothing came. */
  function drawFolds(bottom) {
    for (const [from, to, idle] of data.folds) {
      const [left, right] = [x(from), x(to)];
      if (right < gutter || left > width) continue;
      context.save();
      context.beginPath();
      context.rect(gutter, 0, width - gutter, bottom);
      context.clip();
      context.fillStyle = colours.paper;
      context.fillRect(left, 0, right - left, bottom);
      context.strokeStyle = colours.dim;
      for (const at of [left, right]) {
        context.beginPath();
        for (let y = 0; y <= bottom; y += 6) context.lineTo(at + ((y / 6) % 2 ? 1.5 : -1.5), y);
        context.stroke();
      }
      context.translate((left + right) / 2, (bottom - GAP) / 2);
      context.rotate(-Math.PI / 2);
      context.textAlign = "center";
      context.fillStyle = colours.dim;
      if (right - left >= 14) context.fillText(`${idle} without traffic`, 0, 0);
      context.restore();
    }
  }

  /** Calls `each` with every row that is in the view, and where it begins and ends (px). */
  function eachState(each) {
    const [since, until] = shown();
    const first = Math.max(0, placeOf(since, states.t));
    for (let row = first; row < states.t.length && states.t[row] <= until; row += 1) {
      const next = row + 1 < states.t.length ? states.t[row + 1] : end;
      const [from, to] = [x(states.t[row]), x(next)].map((at) => Math.round(at));
      each(row, Math.max(from, gutter), Math.min(to, width));
    }
  }

  function drawMotion(lane, top) {
    // Where several rows fall into one pixel, each motion is drawn there once.
    const drawn = data.motions.map(() => [-1, -1]);
    eachState((row, from, to) => {
      const bits = seen(row);
      data.motions.forEach((_, place) => {
        for (const turning of [0, 1]) {
          if (!((bits >> (2 * place + turning)) & 1) || drawn[place][turning] >= to) continue;
          drawn[place][turning] = Math.max(to, from + 1);
          context.fillStyle = turning ? colours.device : colours[place ? "non-strict-bar" : "dim"];
          const thick = turning ? ROW - 4 : 3;
          const y = top + place * ROW + (ROW - thick) / 2;
          context.fillRect(from, y, Math.max(to - from, 1), thick);
        }
      });
    });
    return (narrow) => {
      context.font = `11px ${colours.font}`;
      context.textAlign = narrow ? "left" : "right";
      data.motions.forEach((name, place) => {
        label(name, narrow ? 5 : gutter - 6, top + (place + 0.5) * ROW + 1);
      });
      context.font = `12px ${colours.font}`;
    };
  }

  function drawRange(lane, top) {
    const [low, high] = data.bounds[lane.name];
    const scale = (lane.height - 6) / (high - low || 1);
    const y = (value) => top + 3 + (high - value) * scale;
    const zero = y(Math.min(Math.max(0, low), high));
    context.fillStyle = colours.line;
    context.fillRect(gutter, Math.round(zero), width - gutter, 1);
    let before = null;
    eachState((row, from, to) => {
      const [least, most] = range(lane.name, row);
      const size = Math.max(to - from, 1);
      context.fillStyle = colours.host;
      context.globalAlpha = 0.14;
      const value = Math.abs(most) > Math.abs(least) ? most : least;
      context.fillRect(from, Math.min(y(value), zero), size, Math.abs(y(value) - zero));
      context.globalAlpha = 1;
      context.fillRect(from, y(most) - 1, size, Math.max(2, y(least) - y(most) + 2));
      if (before !== null) {
        const ends = [y(before), y(least), y(most)];
        context.fillRect(from - 0.75, Math.min(...ends) - 1, 1.5, Math.max(...ends) - Math.min(...ends) + 2);
      }
      before = states[lane.name].last[row];
    });
    return (narrow) => scaled(top, [[high, y(high)], [low, y(low)]], narrow);
  }

  /** A word beside a lane, or in it: then what is drawn there keeps clear of it. */
  function label(word, at, y) {
    context.lineWidth = 3;
    context.lineJoin = "round";
    context.strokeStyle = colours.paper;
    context.strokeText(word, at, y);
    context.fillStyle = colours.dim;
    context.fillText(word, at, y);
    context.lineWidth = 1;
  }

  /** Values at a lane's edge, from the highest on, as far as they do not stand on each other. */
  function scaled(top, values, narrow) {
    context.textAlign = "right";
    let free = top + (narrow ? 6 : 21); // the lane's name is above
    for (const [value, y] of values) {
      if (value !== values[0][0] && y < free) continue;
      const at = Math.max(y, free);
      label(String(value), narrow ? width - 5 : gutter - 6, at);
      free = at + 14;
    }
  }

  function drawMarks(lane, top) {
    const most = Math.max(1, ...marks.n);
    const [since, until] = shown();
    const first = Math.max(0, placeOf(since, marks.t));
    context.fillStyle = colours["fail-bar"];
    for (let place = first; place < marks.t.length && marks.t[place] <= until; place += 1) {
      const at = x(marks.t[place]);
      const share = most === 1 ? 0.6 : 0.35 + (0.5 * Math.log(marks.n[place])) / Math.log(most);
      const height = lane.height * share;
      context.fillRect(at - 0.75, top + lane.height - height, 1.5, height);
      context.beginPath();
      context.arc(at, top + lane.height - height, 3.5, 0, 2 * Math.PI);
      context.fill();
    }
    return null;
  }

  function drawLatencies(lane, top) {
    const positive = latencies.low.filter((value) => value > 0);
    const most = latencies.high.reduce((one, other) => Math.max(one, other), 1000);
    const least = positive.reduce((one, other) => Math.min(one, other), most);
    const power = 10 ** Math.floor(Math.log10(least));
    const from = [5, 2, 1].map((times) => times * power).find((one) => one <= least);
    const above = 10 ** Math.floor(Math.log10(most));
    const to = [1, 2, 5, 10].map((times) => times * above).find((one) => one >= most && one > from);
    const scale = (lane.height - 8) / Math.log(to / from);
    const y = (value) => top + 4 + Math.log(to / Math.max(value, from)) * scale;
    const values = [[duration(to), y(to)], [duration(from), y(from)]];
    for (let line = 10 ** Math.ceil(Math.log10(from) - 1e-9); line < to; line *= 10) {
      if (line > from) values.splice(1, 0, [duration(line), y(line)]);
      context.fillStyle = colours.line;
      context.fillRect(gutter, Math.round(y(line)), width - gutter, 1);
    }
    const [since, until] = shown();
    const first = Math.max(0, placeOf(since, latencies.t));
    const span = (data.steps[1] / (view[1] - view[0])) * (width - gutter);
    context.fillStyle = colours.device;
    for (let row = first; row < latencies.t.length && latencies.t[row] <= until; row += 1) {
      const [high, low] = [y(latencies.high[row]), y(latencies.low[row])];
      const size = Math.max(span, 3);
      context.fillRect(x(latencies.t[row]) - (span ? 0 : 1.5), high - 1.5, size, low - high + 3);
    }
    return (narrow) => scaled(top, latencies.t.length ? values : [], narrow);
  }

  function drawMap() {
    const [region, margin] = [view, gutter];
    [view, gutter] = [[begin, LAST], canvas.clientWidth < 560 ? 0 : LEFT];
    fit(overview, calm, MAP);
    const [low, high] = data.bounds[RANGES[0]] ?? [0, 0];
    calm.fillStyle = colours.raised;
    calm.fillRect(gutter, 0, width - gutter, MAP);
    calm.fillStyle = colours.host;
    calm.globalAlpha = 0.5;
    if (RANGES.length) eachState((row, from, to) => {
      const height = ((range(RANGES[0], row)[1] - low) / (high - low || 1)) * (MAP - 4);
      calm.fillRect(from, MAP - height, Math.max(to - from, 1), height);
    });
    calm.globalAlpha = 1;
    calm.fillStyle = colours["fail-bar"];
    for (const t of marks.t) calm.fillRect(x(t) - 0.5, 0, 1, 8);
    calm.fillStyle = colours.paper;
    for (const [first, last] of data.folds) calm.fillRect(x(first), 0, x(last) - x(first), MAP);
    const [from, to] = region.map((place) => x(timeOf(place)));
    calm.globalAlpha = 0.65;
    calm.fillStyle = colours.paper;
    calm.fillRect(gutter, 0, from - gutter, MAP);
    calm.fillRect(to, 0, width - to, MAP);
    calm.globalAlpha = 1;
    calm.strokeStyle = colours.accent;
    calm.lineWidth = 2;
    calm.strokeRect(from + 1, 1, Math.max(to - from - 2, 1), MAP - 2);
    [view, gutter] = [region, margin];
  }

  // -- hands ---------------------------------------------------------------------------------------

  const pointers = new Map();
  let dragged = false;

  function place(event) {
    return event.clientX - canvas.getBoundingClientRect().left;
  }

  canvas.addEventListener(
    "wheel",
    (event) => {
      const unit = event.deltaMode === 1 ? 16 : 1;
      const sideways = event.shiftKey ? event.deltaY || event.deltaX : event.deltaX;
      const changed =
        event.shiftKey || Math.abs(event.deltaX) > Math.abs(event.deltaY)
          ? move((sideways * unit) / width)
          : zoom(Math.exp(event.deltaY * unit * 0.002), timeAt(place(event)));
      if (changed) event.preventDefault(); // at the end of all zooming the page scrolls
    },
    { passive: false },
  );

  canvas.addEventListener("pointerdown", (event) => {
    pointers.set(event.pointerId, place(event));
    canvas.setPointerCapture(event.pointerId);
    dragged = pointers.size > 1;
  });

  canvas.addEventListener("pointermove", (event) => {
    const at = place(event);
    if (!pointers.has(event.pointerId)) {
      aim(timeAt(at));
      return;
    }
    const was = pointers.get(event.pointerId);
    if (!dragged && Math.abs(at - was) < 5) return;
    dragged = true;
    canvas.classList.add("moving");
    if (pointers.size === 2) {
      const other = [...pointers].find(([id]) => id !== event.pointerId)[1];
      const held = timeAt((was + other) / 2);
      zoom(Math.max(1, Math.abs(was - other)) / Math.max(1, Math.abs(at - other)), held);
    }
    move((was - at) / (width - gutter) / pointers.size);
    pointers.set(event.pointerId, at);
  });

  for (const kind of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(kind, (event) => {
      if (!pointers.delete(event.pointerId)) return;
      if (!pointers.size) canvas.classList.remove("moving");
      if (kind === "pointerup" && !dragged) aim(timeAt(place(event)));
    });
  }

  canvas.addEventListener("dblclick", (event) => zoom(0.25, timeAt(place(event))));

  overview.addEventListener("pointerdown", (event) => overview.setPointerCapture(event.pointerId));
  for (const kind of ["pointerdown", "pointermove"]) {
    overview.addEventListener(kind, (event) => {
      if (!event.buttons) return;
      const share = (place(event) - gutter) / (width - gutter);
      const [middle, half] = [begin + share * (LAST - begin), (view[1] - view[0]) / 2];
      show(middle - half, middle + half);
    });
  }

  function arrow(way, event) {
    if (event.shiftKey) return move(way * 0.25);
    const px = (view[1] - view[0]) / (width - gutter);
    const from = cursor === null ? view[0] : along(cursor);
    return goTo(timeOf(Math.min(Math.max(from + way * 4 * px, begin), LAST)));
  }

  const KEYS = {
    "+": () => zoom(0.5),
    "=": () => zoom(0.5),
    "-": () => zoom(2),
    0: () => show(begin, LAST),
    Escape: () => show(begin, LAST),
    n: () => step(1),
    N: () => step(-1),
    ArrowLeft: (event) => arrow(-1, event),
    ArrowRight: (event) => arrow(1, event),
    PageUp: () => move(-0.9),
    PageDown: () => move(0.9),
    Home: () => goTo(begin),
    End: () => goTo(end),
  };
  canvas.addEventListener("keydown", (event) => {
    const does = event.ctrlKey || event.metaKey || event.altKey ? null : KEYS[event.key];
    if (!does) return;
    does(event);
    event.preventDefault();
  });

  const BUTTONS = {
    in: () => zoom(0.5),
    out: () => zoom(2),
    all: () => show(begin, LAST),
    previous: () => step(-1),
    next: () => step(1),
  };
  tools.addEventListener("click", (event) => BUTTONS[event.target.dataset.do]?.());

  /** `#t=5000000` shows what is around that time (ns), `#view=0-5000000` from one to the other. */
  function follow() {
    const time = /^#t=(\d+)$/.exec(location.hash);
    const both = /^#view=(\d+)-(\d+)$/.exec(location.hash);
    if (both) show(along(Number(both[1])), along(Number(both[2])));
    if (!time) return;
    const half = Math.min(view[1] - view[0], (LAST - begin) / 8) / 2;
    const middle = along(Number(time[1]));
    show(middle - half, middle + half);
    aim(Number(time[1]));
    canvas.scrollIntoView({ block: "center" });
    canvas.focus({ preventScroll: true });
  }

  for (const hidden of [tools, readout]) hidden.hidden = false;
  for (const name of ["previous", "next"]) {
    tools.querySelector(`[data-do="${name}"]`).disabled = !marks.t.length;
  }
  width = canvas.clientWidth;
  window.addEventListener("hashchange", follow);
  new ResizeObserver(redraw).observe(canvas.parentElement);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  follow();
  aim(cursor ?? begin);
  draw();
})();
