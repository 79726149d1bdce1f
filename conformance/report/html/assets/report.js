// Filters the list of cases, and draws what is inside a case when it is opened. Text goes in as text
// only: nothing here writes markup.
"use strict";
(() => {
  const SVG = "http://www.w3.org/2000/svg";
  const [SENT, RECEIVED, LOOK, CLIPPED] = [0, 1, 2, 3];
  const list = document.getElementById("list");
  const rows = [...list.querySelectorAll("details")];
  const shown = document.getElementById("shown");
  const filters = document.getElementById("filters");
  const search = document.getElementById("search");
  const scopeChip = document.getElementById("scope");
  const chips = [...filters.querySelectorAll(".chip[data-v]")];
  const verdicts = rows.map((row) => row.dataset.v.split(" "));
  const words = rows.map((row) => `${row.textContent} ${row.dataset.c}`.toLowerCase());
  const chosen = new Set();
  const scope = { clause: "", group: "" };
  let parsed = null;

  function data() {
    parsed ??= JSON.parse(document.getElementById("data").textContent);
    return parsed;
  }

  // -- filters ----------------------------------------------------------------------------------

  function apply() {
    const text = search.value.trim().toLowerCase();
    let count = 0;
    rows.forEach((row, index) => {
      const fits =
        (!chosen.size || verdicts[index].some((verdict) => chosen.has(verdict))) &&
        (!scope.clause || row.dataset.c === scope.clause) &&
        (!scope.group || row.dataset.g === scope.group) &&
        (!text || words[index].includes(text));
      row.hidden = !fits;
      count += fits;
    });
    for (const chip of chips) {
      chip.setAttribute("aria-pressed", String(chosen.has(chip.dataset.v)));
    }
    const where = [scope.clause, scope.group].filter(Boolean).join(" · ");
    scopeChip.hidden = !where;
    scopeChip.textContent = `${where} ×`;
    scopeChip.setAttribute("aria-label", `No longer only ${where}`);
    const total = rows.length.toLocaleString("en");
    const all = count === rows.length;
    shown.textContent = all ? `${total} cases` : `${count.toLocaleString("en")} of ${total} cases`;
    document.getElementById("everything").hidden = all;
  }

  function clear() {
    chosen.clear();
    scope.clause = scope.group = search.value = "";
  }

  for (const chip of chips) {
    chip.addEventListener("click", () => {
      if (!chosen.delete(chip.dataset.v)) chosen.add(chip.dataset.v);
      apply();
    });
  }
  search.addEventListener("input", apply);
  scopeChip.addEventListener("click", () => {
    scope.clause = scope.group = "";
    apply();
    search.focus();
  });
  document.getElementById("everything").addEventListener("click", () => {
    clear();
    apply();
    search.focus();
  });
  document.querySelector(".matrix")?.addEventListener("click", (event) => {
    const link = event.target.closest("a");
    if (!link) return;
    clear();
    scope.clause = link.dataset.c;
    scope.group = link.dataset.g;
    if (link.dataset.v) chosen.add(link.dataset.v);
    apply();
  });

  // -- building ---------------------------------------------------------------------------------

  function fill(node, attributes, content) {
    for (const [name, value] of Object.entries(attributes)) {
      if (value !== null) node.setAttribute(name, String(value));
    }
    node.append(...content);
    return node;
  }

  function make(name, attributes = {}, ...content) {
    return fill(document.createElement(name), attributes, content);
  }

  function draw(name, attributes = {}, ...content) {
    return fill(document.createElementNS(SVG, name), attributes, content);
  }

  function table(css, titles, lines) {
    const head = make("tr", {}, ...titles.map((title) => make("th", { scope: "col" }, title)));
    return make(
      "div",
      { class: "scroll" },
      make("table", { class: css }, make("thead", {}, head), make("tbody", {}, ...lines)),
    );
  }

  function badge(verdict) {
    const word = verdict === "missing" ? "not run" : verdict;
    return make("span", { class: `badge v-${verdict}` }, word);
  }

  function duration(us) {
    if (us >= 1e6) return `${(us / 1e6).toFixed(2)} s`;
    if (us >= 1e5) return `${Math.round(us / 1e3)} ms`;
    if (us >= 1e3) return `${(us / 1e3).toFixed(1)} ms`;
    return `${us} µs`;
  }

  // -- one case ---------------------------------------------------------------------------------

  function open(row) {
    if (row.querySelector(".inside")) return;
    const { runs, known, cases } = data();
    const results = cases[Number(row.dataset.i)];
    const inside = make("div", { class: "inside" });
    row.append(inside);
    results.forEach((result, index) => {
      const run = make("article", {});
      inside.append(run);
      if (runs.length > 1) {
        run.append(make("h3", {}, runs[index], " ", badge(result ? result.v : "missing")));
      }
      if (result) one(run, result, known[index]);
      else run.append(make("p", { class: "dim" }, "This run has no such case."));
    });
  }

  function one(run, result, known) {
    const text = data().strings;
    run.append(
      make("p", { class: "required" }, text[result.q]),
      make("p", { class: "dim" }, text[result.c]),
      axes(result, text),
    );
    const ids = new Set([result.r, ...result.a.map((axis) => axis[5])].map((at) => text[at]));
    for (const id of ids) if (id) run.append(reading(id));
    if (result.s.length) {
      const frames = result.s.map((at) => make("code", {}, text[at]));
      run.append(make("p", { class: "sent" }, make("span", { class: "label" }, "sent"), ...frames));
    }
    run.append(make("h4", {}, "Timing"));
    if (result.log.length) {
      run.append(timing(result.log, text, run.clientWidth));
      run.append(make("h4", {}, "Wire log"));
      if (!known) {
        run.append(
          make("p", { class: "dim" }, "This run was made with another grammar than this page: ",
            "name it with bilprov --grammar FILE.py report to see what the bytes mean."),
        );
      }
      run.append(log(result.log, text));
    } else {
      run.append(make("p", { class: "dim" }, "There is no wire log of this case."));
    }
    run.append(make("h4", {}, "Try it again"), again(text[result.again]));
  }

  function axes(result, text) {
    const lines = result.a.map(([name, verdict, expected, actual, reason]) =>
      make("tr", { class: `axis a-${verdict}` },
        make("th", { scope: "row" }, text[name]),
        make("td", {}, badge(verdict)),
        make("td", {}, text[expected]),
        make("td", {}, text[actual]),
        make("td", {}, text[reason])));
    return table("axes", ["axis", "verdict", "expected", "actual", "reason"], lines);
  }

  function reading(id) {
    const about = data().readings[id];
    if (!about) return make("p", { class: "reading" }, make("code", {}, id));
    const list = make("dl", {});
    const entry = (name, words) => list.append(make("div", {}, make("dt", {}, name), words));
    entry("our default", make("dd", {}, about.default));
    for (const [choice, verdict] of about.others) {
      entry(choice, make("dd", { class: "verdict" }, verdict));
    }
    const point = make("p", {}, make("code", {}, id), " ", make("b", {}, about.point));
    const quote = about.quote && make("blockquote", { lang: "sv" }, about.quote);
    const clause = make("p", { class: "dim" }, `Rests on a reading of ${about.clause}`);
    return make("div", { class: "reading" }, point, clause, ...(quote ? [quote] : []), list);
  }

  const ARROWS = { [SENT]: "host →", [RECEIVED]: "← device", [LOOK]: "probe", [CLIPPED]: "…" };

  function log(events, text) {
    let before = 0;
    const lines = events.map(([t, kind, hex, meaning]) => {
      const since = t - before;
      before = t;
      return make("tr", { class: `k-${kind}` },
        make("td", { class: "number" }, (t / 1000).toFixed(3)),
        make("td", { class: "number dim" }, since ? `+${(since / 1000).toFixed(3)}` : ""),
        make("td", { class: "who" }, ARROWS[kind]),
        make("td", { class: "hex" }, text[hex]),
        make("td", {}, text[meaning]));
    });
    return table("log", ["ms", "since", "who", "bytes", "meaning"], lines);
  }

  function again(command) {
    const code = make("code", { tabindex: 0 }, command);
    const button = make("button", { type: "button", class: "chip" }, "Copy");
    copies(button, code);
    return make("p", { class: "again" }, code, button);
  }

  function copies(button, code) {
    button.addEventListener("click", async () => {
      try {
        await navigator.clipboard.writeText(code.textContent);
        button.textContent = "Copied";
      } catch {
        getSelection().selectAllChildren(code);
        button.textContent = "Selected: press Ctrl-C";
      }
    });
  }

  // -- the timing picture -----------------------------------------------------------------------

  const LEFT = 62;
  const LANES = { [SENT]: 36, [RECEIVED]: 78, [LOOK]: 120 };

  const LABELED = 20; // µs; there is no room for a label at a shorter pause

  // How wide a pause is drawn: by its logarithm, so that 20 µs and 20 s both show, and each label fits.
  function room(gap) {
    if (!gap) return 0;
    if (gap < LABELED) return 10 + 0.3 * gap;
    return 14 + 6.7 * duration(gap).length + 14 * Math.log10(gap / LABELED);
  }

  function places(events, width) {
    const gaps = events.slice(1).map(([t], index) => t - events[index][0]);
    const sum = gaps.reduce((total, gap) => total + room(gap), 0);
    const scale = Math.max(sum ? (width - LEFT - 80) / sum : 1, 1);
    const xs = [LEFT + 14];
    for (const gap of gaps) xs.push(xs[xs.length - 1] + room(gap) * scale);
    return { xs, gaps, width: Math.max(xs[xs.length - 1] + 66, width) };
  }

  function timing(events, text, available) {
    const { xs, gaps, width } = places(events, Math.max(available - 2, 300));
    const last = events[events.length - 1][0];
    const picture = draw("svg", {
      class: "timing", width, height: 168, viewBox: `0 0 ${width} 168`, role: "img",
      "aria-label": `${events.length} entries in ${duration(last)}; the wire log below lists them`,
    });
    for (const [kind, name] of [[SENT, "host"], [RECEIVED, "device"], [LOOK, "probe"]]) {
      const y = LANES[kind];
      picture.append(
        draw("line", { x1: LEFT, x2: width - 8, y1: y, y2: y, class: "lane" }),
        draw("text", { x: 4, y: y + 4, class: "name" }, name),
      );
    }
    gaps.forEach((gap, index) => {
      if (gap < LABELED) return;
      const [from, to] = [xs[index], xs[index + 1]];
      picture.append(
        draw("path", { d: `M${from} 138v6M${from} 141H${to}M${to} 138v6`, class: "span" }),
        draw("text", { x: (from + to) / 2, y: 158, class: "pause" }, duration(gap)),
      );
    });
    const free = {};
    events.forEach(([t, kind, hex, meaning], index) => {
      const x = xs[index];
      const told = `${(t / 1000).toFixed(3)} ms ${ARROWS[kind]} ${text[hex]} ${text[meaning]}`;
      const title = draw("title", {}, told);
      if (kind === LOOK) {
        const state = /^moving(?! unknown)/.test(text[meaning]) ? "moving" : "still";
        picture.append(draw("circle", { cx: x, cy: LANES[LOOK], r: 5, class: state }, title));
        return;
      }
      const y = LANES[kind] ?? LANES[RECEIVED];
      const css = kind === CLIPPED ? "clipped" : kind === SENT ? "host" : "device";
      const bytes = (text[hex].length + 1) / 3;
      const size = Math.min(3 + bytes, 8);
      picture.append(draw("rect", { x: x - 1, y: y - 8, width: size, height: 16, rx: 1.5, class: css }, title));
      const label = text[hex].length > 11 ? `${text[hex].slice(0, 5)}…×${bytes}` : text[hex];
      const wide = label.length * 6.4 + 8;
      if (x >= (free[y] ?? 0)) {
        picture.append(draw("text", { x: x - 1, y: y - 13, class: "bytes" }, label));
        free[y] = x + wide;
      }
    });
    const legend = make("p", { class: "legend dim" },
      make("span", { class: "dot moving" }), " seen moving ",
      make("span", { class: "dot still" }), " seen at rest; widths by the logarithm of the pause");
    return make("div", {}, make("div", { class: "scroll picture", tabindex: 0 }, picture), legend);
  }

  // -- begin ------------------------------------------------------------------------------------

  list.addEventListener("toggle", (event) => {
    const row = event.target;
    if (!row.open) return;
    open(row);
    history.replaceState(null, "", `#case=${encodeURIComponent(row.dataset.id)}`);
  }, true);

  function follow() {
    const asked = /^#case=(.*)$/.exec(location.hash);
    if (!asked) return;
    let id = "";
    try {
      id = decodeURIComponent(asked[1]);
    } catch {
      return;
    }
    const row = rows.find((candidate) => candidate.dataset.id === id);
    if (!row) return;
    if (row.hidden) {
      clear();
      apply();
    }
    row.open = true;
    row.scrollIntoView({ block: "start" });
  }

  for (const button of document.querySelectorAll(".cause .again button")) {
    copies(button, button.previousElementSibling);
  }

  filters.hidden = false;
  // What did not pass is what one came for.
  const bad = ["error", "fail", "non-strict", "inconclusive", "differs"];
  for (const chip of chips) if (bad.includes(chip.dataset.v)) chosen.add(chip.dataset.v);
  if (!verdicts.some((marks) => marks.some((mark) => chosen.has(mark)))) chosen.clear();
  apply();
  addEventListener("hashchange", follow);
  follow();
})();
