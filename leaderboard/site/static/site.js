// Tables that sort and filter (DataTables), charts that can be hovered (Plotly). Texts of records
// reach the page as text only: by textContent, or with escaped markup where Plotly reads markup.
(() => {
  "use strict";
  const MINUS = "\u2212";
  const root = document.documentElement;

  // ---------------------------------------------------------------- tables

  const leadingNumber = (text) => {
    const found = text.trim().replaceAll(MINUS, "-").match(/^[>=(]*\s*([-+]?[\d.]+(?:e[-+]?\d+)?)\s*([kM])?/i);
    if (!found) return null;
    return Number(found[1]) * ({ k: 1e3, M: 1e6 }[found[2]] || 1);
  };

  // Tables that come from the leaderboard's text: a column of numbers sorts by what its cells begin with.
  const addOrder = (table) => {
    const rows = [...(table.tBodies[0]?.rows || [])];
    for (let column = 0; column < (rows[0]?.cells.length || 0); column += 1) {
      const cells = rows.map((row) => row.cells[column]).filter(Boolean);
      const values = cells.map((cell) => leadingNumber(cell.textContent));
      if (2 * values.filter((value) => value !== null).length < cells.length) continue;
      cells.forEach((cell, k) => { cell.dataset.order = values[k] === null ? "" : String(values[k]); });
    }
  };

  const facetsOf = (bar) => [...bar.querySelectorAll("select")];

  // A cell may have several values, and counts before them, which are not filtered by.
  const valuesOf = (cell) => (cell.dataset.facet !== undefined ? [cell.dataset.facet]
    : cell.textContent.split(", ").map((text) => text.replace(/^\d+\s/, "")));

  const element = (name, values = {}, ...children) => {
    const made = Object.assign(document.createElement(name), values);
    made.append(...children);
    return made;
  };

  // A choice for each column of the kind "f" that has several values; null where there is none.
  const filtersOf = (table, rows) => {
    const selects = [...table.tHead.rows[0].cells].flatMap((head, column) => {
      const values = [...new Set(rows.flatMap((row) => valuesOf(row.cells[column])))].sort();
      if (!head.classList.contains("f") || values.length < 2) return [];
      const select = element("select", { name: head.textContent }, element("option", { value: "" }, "all"), ...values.map((value) => element("option", { value }, value)));
      select.dataset.column = column;
      return [element("label", {}, head.textContent, select)];
    });
    const all = element("button", { type: "button", className: "plain" }, "Show all");
    const bar = element("div", { className: "filters" }, ...selects, all);
    return selects.length ? element("details", { open: innerWidth > 620 }, element("summary", {}, "Filters"), bar) : null;
  };

  const readAddress = (bar) => {
    const wanted = new URLSearchParams(location.hash.slice(1));
    for (const select of facetsOf(bar)) {
      const value = wanted.get(select.name);
      if (value !== null && [...select.options].some((option) => option.value === value)) select.value = value;
    }
  };

  const writeAddress = (bar) => {
    const chosen = facetsOf(bar).filter((select) => select.value);
    const text = new URLSearchParams(chosen.map((select) => [select.name, select.value])).toString();
    history.replaceState(null, "", text ? `#${text}` : location.pathname + location.search);
  };

  const makeTable = (table) => {
    const DataTable = SymSteerTables.default;
    const page = Number(table.dataset.page || 0);
    if (!table.classList.contains("data")) addOrder(table);
    const search = page > 0;
    const rows = [...(table.tBodies[0]?.rows || [])];
    const bar = search ? filtersOf(table, rows) : null;
    if (bar) table.before(bar);
    // Of all rows, not of those alone that the present page shows.
    const values = rows.map((row) => (bar ? facetsOf(bar).map((select) => valuesOf(row.cells[select.dataset.column])) : []));
    const made = new DataTable(table, {
      paging: page > 0 && rows.length > page,
      pageLength: page || 10,
      info: search,
      searching: true,
      order: [],
      autoWidth: false,
      orderClasses: false,
      layout: {
        topStart: null,
        topEnd: search ? { search: { placeholder: "Search", text: "" } } : null,
        bottomStart: search ? "info" : null,
        bottomEnd: page ? { paging: { buttons: 5 } } : null,
      },
      columnDefs: [{ targets: "n", type: "num", orderSequence: ["desc", "asc"] }],
      language: { emptyTable: "Nothing here.", zeroRecords: "No row has all of this." },
    });
    made.table().container().querySelector("input[type=search]")?.setAttribute("aria-label", "Search this table");
    const box = made.table().container().querySelector(".dt-layout-table");
    if (box && !table.closest(".scroll")) {
      box.tabIndex = 0;
      box.setAttribute("role", "region");
      box.setAttribute("aria-label", table.caption?.textContent || "Table");
    }
    if (!bar) return;
    const matches = (index) => facetsOf(bar).every((s, k) => !s.value || values[index][k].includes(s.value));
    made.search.fixed("facets", (_text, _data, index) => matches(index));
    readAddress(bar);
    if (facetsOf(bar).some((select) => select.value)) made.draw();
    bar.addEventListener("change", () => { made.draw(); writeAddress(bar); });
    bar.querySelector("button")?.addEventListener("click", () => {
      for (const select of facetsOf(bar)) select.value = "";
      made.search("").draw();
      writeAddress(bar);
    });
    addEventListener("hashchange", () => { readAddress(bar); made.draw(); });
  };

  // ---------------------------------------------------------------- charts

  // Plotly reads <b>, <a> and entities in texts.
  const safe = (text) => String(text).replaceAll("&", "&amp;").replaceAll("<", "&lt;").replaceAll(">", "&gt;");
  const shown = (value) => Number(value.toPrecision(3)).toString().replace("-", MINUS);
  const isDark = () => root.dataset.theme === "dark";
  const css = (name) => getComputedStyle(root).getPropertyValue(name).trim();
  // The colour that a dark page needs: mixed with white until the contrast is 4.5 (WCAG 2).
  const brightness = (parts) => [0.2126, 0.7152, 0.0722].reduce((sum, share, k) => sum + share * (parts[k] / 255) ** 2.2, 0);
  const shade = (hex) => {
    if (!isDark()) return hex;
    const parts = [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16));
    let mixed = parts;
    for (let share = 0; share < 1 && brightness(mixed) < 0.216; share += 0.04) mixed = parts.map((part) => Math.round(part + (255 - part) * share));
    return `#${mixed.map((part) => part.toString(16).padStart(2, "0")).join("")}`;
  };
  const faint = (color, share) => color + Math.round(255 * share).toString(16).padStart(2, "0");
  const steps = (value) => (Math.abs(value) >= 1e6 ? `${shown(value / 1e6)}M` : Math.abs(value) >= 1e3 ? `${shown(value / 1e3)}k` : shown(value));

  // Plotly's names of matplotlib's markers and line styles; the latter are tried in turn where rows of one agent differ in settings.
  const SYMBOLS = { s: "square", D: "diamond", v: "triangle-down", o: "circle", "^": "triangle-up", X: "x", P: "cross", "<": "triangle-left", h: "hexagon", ">": "triangle-right", "*": "star", p: "pentagon", d: "diamond-tall" };
  const DASHES = { "-": "solid", ":": "dot", "0,5,2": "dash", "0,3,1.5": "dash", "0,1,1.5": "dot", "0,5,1.5,1,1.5": "dashdot" };
  const TWINS = ["solid", "dot", "dash", "longdash", "dashdot"];
  const PIXELS = 4 / 3;
  const symbolOf = (look) => (look.marker ? SYMBOLS[look.marker] + (look.hollow ? "-open" : "") : undefined);

  const twins = (legend) => {
    const taken = new Set();
    for (const one of legend) {
      const free = TWINS.filter((dash) => !taken.has(one.look.color + dash));
      const wanted = DASHES[String(one.look.dash)];
      one.dash = wanted && taken.has(one.look.color + wanted) ? free[0] || wanted : wanted;
      taken.add(one.look.color + one.dash);
    }
  };

  const PLACES = [0.001, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10];
  const isLog = (axis) => axis.scale === "log";
  const axisOf = (spec, narrow = innerWidth < 620) => ({
    title: { text: safe(spec.title || ""), standoff: 8, font: { size: 13, color: css("--muted") } },
    range: isLog(spec) && spec.ends ? spec.ends.map(Math.log10) : spec.ends,
    type: isLog(spec) ? "log" : "linear",
    zeroline: false,
    gridcolor: css("--line"),
    linecolor: css("--line"),
    tickfont: { size: narrow ? 10 : 12, color: css("--muted") },
    tickformat: spec.in_steps ? "~s" : undefined,
    exponentformat: isLog(spec) ? "power" : "e",
    dtick: isLog(spec) ? 1 : spec.every || undefined,
    ...(isLog(spec) && spec.ends ? { tickvals: PLACES, ticktext: PLACES.map(String) } : {}),
    nticks: narrow ? 5 : 7,
    automargin: true,
    fixedrange: false,
    // Places from top to bottom that have names.
    ...(spec.labels ? {
      tickvals: spec.labels.map((_, k) => k), range: [spec.labels.length - 0.4, -0.6],
      ticktext: spec.labels.map((text) => safe(narrow ? text.replace(/(.{8,18})\s/g, "$1\n") : text).replaceAll("\n", "<br>")),
    } : {}),
  });

  // The ends of an interval as the arms of an error bar.
  const arms = (found, color, thickness) => (found.high === undefined ? undefined : {
    type: "data", symmetric: false, color, thickness, width: 0,
    array: [Math.max(0, found.high - found.value)], arrayminus: [Math.max(0, found.value - found.low)],
  });
  const between = (value, low, high) => `${shown(value)}${low === undefined ? "" : ` [${shown(low)}, ${shown(high)}]`}`;

  const lineOf = (one, spec, dash) => {
    const look = one.look, color = shade(look.color), last = one.x.length - 1;
    const where = spec.x.in_steps ? (x) => `${steps(x)} steps` : shown;
    const name = `<b>${safe(one.name)}</b>${one.label ? `, ${safe(one.label)}` : ""}`;
    return {
      x: one.x, y: one.y, opacity: look.alpha || 1,
      mode: look.dash === "none" ? "markers" : look.marker || one.single ? "lines+markers" : "lines",
      line: { color, width: look.width * PIXELS, dash: one.single ? DASHES[look.dash] : dash },
      marker: { color, line: { color, width: 1.6 },
        size: one.x.map((_, k) => (one.cross && k === last ? 8 : one.single ? 3 : look.size * PIXELS)),
        symbol: one.x.map((_, k) => (one.cross && k === last ? "x-thin-open" : symbolOf(look) || "circle")) },
      text: one.y.map((y, k) => `${name}<br>${where(one.x[k])}: ${between(y, one.low?.[k], one.high?.[k])}${one.remark ? `<br>${safe(one.remark)}` : ""}`),
      hovertemplate: "%{text}<extra></extra>",
    };
  };

  const bandOf = (one) => ({
    x: [...one.x, ...[...one.x].reverse()], y: [...one.high, ...[...one.low].reverse()],
    fill: "toself", fillcolor: faint(shade(one.look.color), 0.11), line: { width: 0 }, mode: "lines", hoverinfo: "skip",
  });

  const dotOf = (one, spec) => {
    const look = one.look, color = shade(look.color);
    const y = one.y.value ?? one.y;
    const texts = [`<b>${safe(one.name)}</b>`, spec.y.labels ? safe(spec.y.labels[Math.round(y)]) : "", between(one.x.value, one.x.low, one.x.high), safe(one.text || ""), safe(one.remark || "")];
    return {
      x: [one.x.value], y: [y], mode: "markers", opacity: look.alpha || 1,
      marker: { color, size: look.size * PIXELS, symbol: symbolOf(look), line: { color, width: 1.6 } },
      error_x: arms(one.x, one.thick ? faint(color, 0.35) : color, one.thick ? 8 : look.width * PIXELS),
      error_y: arms(one.y, color, look.width * PIXELS),
      text: [texts.filter((text) => text).join("<br>")],
      hovertemplate: "%{text}<extra></extra>",
    };
  };

  const plotOf = (spec, state) => {
    const seen = (one) => !state.hidden.has(one.name) && (!one.single || one.cross || state.runs);
    const lines = (spec.traces || []).filter(seen);
    const dash = Object.fromEntries(spec.legend.map((one) => [one.name, one.dash]));
    const traces = [
      ...lines.filter((one) => one.band).map(bandOf), ...lines.map((one) => lineOf(one, spec, dash[one.name])),
      ...(spec.dots || []).filter(seen).map((one) => dotOf(one, spec)),
    ];
    const shapes = (spec.rules || []).map((rule) => ({
      type: "line", layer: "below", line: { color: css("--muted"), width: 1, dash: DASHES[rule.dash] },
      ...(rule.is_vertical ? { x0: rule.at, x1: rule.at, yref: "paper", y0: 0, y1: 1 } : { y0: rule.at, y1: rule.at, xref: "paper", x0: 0, x1: 1 }),
    }));
    if (spec.feasible) {
      shapes.push({
        type: "rect", xref: "paper", x0: 0, x1: 1, y0: spec.feasible[0], y1: spec.feasible[1], layer: "below",
        fillcolor: isDark() ? "#2c3a24" : "#e8f0dc", line: { width: 1, color: isDark() ? "#5b7a3c" : "#a9c284" },
      });
    }
    const height = spec.y.labels ? { height: Math.max(200, 90 + spec.y.labels.length * (innerWidth < 620 ? 38 : 30)) } : {};
    return { traces, layout: { shapes, xaxis: axisOf(spec.x), yaxis: axisOf(spec.y), ...height } };
  };

  const WORDS = ["no success", "success, not at the end", "success at the end"];

  const episodes = (spec) => {
    const dark = isDark();
    const scale = [dark ? "#39414e" : "#e4e7eb", dark ? "#2a6a94" : "#8cc4e6", dark ? "#6bb6ec" : "#0072b2"];
    const z = spec.rows.map((row) => row.cells.map((cell) => (cell ? cell[0] : null)));
    const text = spec.rows.map((row) => row.cells.map((cell, k) => (cell
      ? `<b>${WORDS[cell[0]]}</b><br>seed ${spec.seeds[k]}, ${safe(row.name)} steps<br>return ${cell[1] === null ? "not finite" : shown(cell[1])}, ${cell[2]} steps long` : "")));
    const colorscale = scale.flatMap((color, k) => [[k / 3, color], [(k + 1) / 3, color]]);
    const traces = [{
      type: "heatmap", z, text, x: spec.seeds.map((_, k) => k), y: spec.rows.map((row) => safe(row.name)),
      zmin: -0.5, zmax: 2.5, colorscale, showscale: false, xgap: 1, ygap: 2, hovertemplate: "%{text}<extra></extra>", hoverongaps: false,
    }];
    const yaxis = { ...axisOf({ title: spec.rows.length > 4 ? "environment steps" : "steps" }), type: "category", autorange: "reversed", nticks: undefined, showgrid: false };
    return { traces, layout: { xaxis: { ...axisOf({ title: "held-out episodes" }), showgrid: false }, yaxis, height: 110 + 24 * spec.rows.length } };
  };

  const draw = (figure) => {
    const { spec, state, plot } = figure;
    const { traces, layout } = spec.seeds ? episodes(spec) : plotOf(spec, state);
    const full = {
      font: { family: css("--sans"), size: 13, color: css("--text") },
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      margin: { l: 48, r: 12, t: 8, b: 44 }, showlegend: false, hovermode: "closest",
      hoverlabel: { bgcolor: css("--bg"), bordercolor: css("--muted"), font: { family: css("--sans"), size: 13, color: css("--text") }, align: "left" },
      dragmode: matchMedia("(pointer: coarse)").matches ? false : "zoom",
      ...layout,
    };
    if (layout.height) plot.style.height = `${layout.height}px`;
    return Plotly.react(plot, traces, full, {
      responsive: true, displaylogo: false, displayModeBar: false, scrollZoom: false,
    });
  };

  const swatch = (series) => {
    const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
    svg.setAttribute("viewBox", "0 0 30 12");
    svg.setAttribute("aria-hidden", "true");
    const add = (name, values) => {
      const node = document.createElementNS("http://www.w3.org/2000/svg", name);
      for (const [key, value] of Object.entries(values)) node.setAttribute(key, value);
      svg.append(node);
    };
    const dashes = { dash: "6 3", dot: "1.5 3", dashdot: "6 3 1.5 3", longdash: "9 3" };
    const look = series.look, color = shade(look.color), symbol = symbolOf(look);
    if (look.edge) add("path", { d: "M5 2h20v8H5z", fill: look.edge === look.color ? color : faint(shade(look.edge), 0.3), stroke: shade(look.edge) });
    else if (series.dash) add("line", { x1: 0, x2: 30, y1: 6, y2: 6, stroke: color, "stroke-width": 2.4, "stroke-dasharray": dashes[series.dash] || "none" });
    const shape = { square: "M11 2h8v8h-8z", diamond: "M15 1l5 5-5 5-5-5z", "triangle-up": "M15 1l5 9H10z", "triangle-down": "M15 11l5-9H10z", x: "M11 2l8 8M19 2l-8 8", cross: "M15 1v10M10 6h10" }[symbol?.replace("-open", "")];
    const fill = look.hollow ? css("--raised") : color;
    if (shape) add("path", { d: shape, fill, stroke: color, "stroke-width": 1.5 });
    else if (symbol) add("circle", { cx: 15, cy: 6, r: 3.6, fill, stroke: color, "stroke-width": 1.5 });
    return svg;
  };

  const legend = (figure) => {
    const { spec, state, box } = figure;
    if (!spec.legend || (spec.legend.length < 2)) return;
    const button = (text, pressed, mark, toggle) => {
      const made = element("button", { type: "button" }, ...mark, element("span", {}, text));
      made.setAttribute("aria-pressed", String(pressed));
      made.addEventListener("click", () => { toggle(); legend(figure); draw(figure); });
      return made;
    };
    const focused = [...box.children].indexOf(document.activeElement);
    box.replaceChildren(...spec.legend.map((one) => {
      // What no line or dot is called explains colours and markers.
      if (!one.drawn) return element("span", { className: "key" }, swatch(one), element("span", {}, one.name));
      return button(one.name, !state.hidden.has(one.name), [swatch(one)], () => {
        state.hidden.has(one.name) ? state.hidden.delete(one.name) : state.hidden.add(one.name);
      });
    }));
    if ((spec.traces || []).some((one) => one.single)) {
      const runs = button("single runs", state.runs, [], () => { state.runs = !state.runs; });
      runs.className = "runs";
      box.append(runs);
    }
    if (focused >= 0) box.children[focused].focus();
  };

  const figures = new Map();
  const seen = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      if (!entry.isIntersecting || !figures.has(entry.target)) continue;
      seen.unobserve(entry.target);
      const figure = figures.get(entry.target);
      figure.drawn = true;
      legend(figure);
      draw(figure);
    }
  }, { rootMargin: "400px" });

  const addFigure = (made, spec) => {
    if (spec.legend) twins(spec.legend);
    figures.set(made, {
      spec, drawn: false,
      // Beside the bands of many agents, single runs hide more than they show.
      state: { hidden: new Set(), runs: !spec.traces || spec.traces.filter((one) => one.band).length < 3 },
      plot: made.querySelector(".plot"), box: made.querySelector(".legend"),
    });
    seen.observe(made);
    return made;
  };

  // ---------------------------------------------------------------- runs

  const chart = (spec, caption) => addFigure(element("figure", { className: "chart" },
    element("p", { className: "title" }, spec.title), element("div", { className: "legend" }),
    element("div", { className: "plot", role: "img", ariaLabel: spec.text }), element("figcaption", {}, caption || spec.note || "")), spec);

  const grid = (rows, name, kind = "") => {
    const lines = rows.map((cells, row) => element("tr", {}, ...cells.map((text, k) => element(row ? "td" : "th", { className: k ? "n" : "" }, text))));
    const table = element("table", { className: kind }, element("thead", {}, lines[0]), element("tbody", {}, ...lines.slice(1)));
    return element("div", { className: "scroll tall", tabIndex: 0, role: "region", ariaLabel: name }, table);
  };

  const lastEpisodes = ({ seeds, rows }) => rows.at(-1).cells.flatMap((cell, k) => (cell ? [[
    String(seeds[k]), cell[0] ? "yes" : "no", cell[0] > 1 ? "yes" : "no", cell[1] === null ? "\u2013" : shown(cell[1]), String(cell[2])]] : []));

  // The run that the address names, of those that the page holds; the first one without a name.
  const showRun = (box, { runs, shared }) => {
    const name = runs[location.hash.slice(1)] ? location.hash.slice(1) : Object.keys(runs)[0];
    const run = runs[name];
    for (const link of document.querySelectorAll(".runs-of a")) link.toggleAttribute("aria-current", link.id === name);
    for (const made of figures.keys()) figures.delete(made);
    const code = element("code", {}, run.commit ? `commit ${run.commit}` : `SymSteer ${run.version}`);
    const part = (title, ...children) => [element("h3", {}, title), ...children];
    box.replaceChildren(
      element("h2", {}, run.name),
      element("p", { className: "lede" }, run.page ? element("a", { href: `../${run.page}` }, run.agent) : run.agent),
      element("dl", { className: "pairs" }, ...Object.entries(run.facts).map(([key, text]) => element("div", {}, element("dt", {}, key), element("dd", {}, text)))),
      ...part("Repeat it"),
      ...(run.command.length ? [element("p", {}, "With the code of ", code, ":"), element("div", { className: "command" },
        element("pre", { tabIndex: 0 }, element("code", { id: "command" }, ...run.command.flatMap((text) => [element("span", {}, text), " "]))),
        element("button", { type: "button", className: "plain" }, "Copy"))]
        : [element("p", {}, "No command of this version of SymSteer gives this configuration, which is listed below. Its code: ", code, ".")]),
      ...(run.films.length ? part("Films and paths", element("div", { className: "columns" }, ...run.films.map(([address, text, isFilm]) => element("figure", {},
        isFilm ? element("video", { controls: true, preload: "metadata", src: `../${address}` }) : element("img", { className: "picture", src: `../${address}`, alt: text }),
        element("figcaption", {}, text))))) : []),
      ...(run.charts.length ? [
        ...part("Curves", element("div", { className: "columns" }, ...run.charts.map((spec) => chart(spec)))),
        ...part("Episodes", chart(run.episodes, "Columns are the held-out initial states, the same for every agent. Dark: success at the end; light: success once, but not at the end; grey: no success.")),
        ...part("Evaluations", grid(run.evaluations, "Evaluations")),
        element("details", {}, element("summary", {}, "Episodes of the last evaluation"),
          grid([["Seed", "Success once", "Success at end", "Return", "Length"], ...lastEpisodes(run.episodes)], "Episodes of the last evaluation")),
      ] : []),
      ...part("Record", element("p", {}, "All of it but the evaluations: configuration, provenance, the base policy, what it cost."),
        grid([["Entry", "Value"], ...Object.entries({ ...shared, ...run.record }).sort()], "Record", "settings")),
    );
  };

  const copy = async (button) => {
    const source = button.parentElement.querySelector("code");
    try {
      await navigator.clipboard.writeText(source.textContent.trim());
      button.textContent = "Copied";
    } catch {
      getSelection().selectAllChildren(source);
      button.textContent = "Selected";
    }
  };

  const start = () => {
    if (globalThis.SymSteerTables) {
      // Errors of a table go to the console; a reader is not stopped by a dialogue.
      SymSteerTables.default.ext.errMode = "throw";
      document.querySelectorAll("table.data, .sortable table").forEach(makeTable);
    }
    for (const made of document.querySelectorAll("figure.chart")) {
      addFigure(made, JSON.parse(made.querySelector("script[type='application/json']").textContent));
    }
    const box = document.getElementById("run");
    if (box) {
      const data = JSON.parse(document.getElementById("runs").textContent);
      const show = () => { showRun(box, data); if (location.hash) box.scrollIntoView(); };
      addEventListener("hashchange", show);
      show();
    }
    document.addEventListener("themechange", () => {
      for (const figure of figures.values()) if (figure.drawn) { legend(figure); draw(figure); }
    });
    document.addEventListener("click", (event) => {
      const button = event.target.closest?.(".command button");
      if (button) copy(button);
    });
    root.classList.add("ready");
  };
  start();
})();
