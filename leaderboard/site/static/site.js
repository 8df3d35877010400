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
    const search = table.dataset.search !== undefined;
    const made = new DataTable(table, {
      paging: page > 0 && table.tBodies[0].rows.length > page,
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
    const bar = document.querySelector(`.filters[data-for="${table.id}"]`);
    if (!bar || !table.id) return;
    // Of all rows, not of those alone that the present page shows.
    const rows = made.rows({ order: "index" }).nodes().toArray().map((row) => JSON.parse(row.dataset.facets));
    const matches = (index) => facetsOf(bar).every((s) => !s.value || rows[index][s.name].includes(s.value));
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
  const colorOf = (series) => series.color[isDark() ? 1 : 0];
  const faint = (color, share) => color + Math.round(255 * share).toString(16).padStart(2, "0");
  const steps = (value) => (Math.abs(value) >= 1e6 ? `${shown(value / 1e6)}M` : Math.abs(value) >= 1e3 ? `${shown(value / 1e3)}k` : shown(value));

  const axisOf = (spec) => ({
    title: { text: safe(spec.title), standoff: 8, font: { size: 13, color: css("--muted") } },
    range: spec.range,
    type: spec.log ? "log" : "linear",
    rangemode: spec.from_zero ? "tozero" : "normal",
    zeroline: Boolean(spec.zero),
    zerolinecolor: css("--muted"),
    gridcolor: css("--line"),
    linecolor: css("--line"),
    tickfont: { size: 12, color: css("--muted") },
    tickformat: spec.si ? "~s" : undefined,
    exponentformat: spec.log ? "power" : "e",
    dtick: spec.log ? 1 : spec.every,
    nticks: 7,
    automargin: true,
    fixedrange: false,
  });

  const curves = (spec, state) => {
    const traces = [];
    spec.series.forEach((one, index) => {
      if (state.hidden.has(index)) return;
      const color = colorOf(one);
      const name = safe(one.name);
      const where = spec.x.si ? steps : shown;
      const label = (x, y, k) => `<b>${name}</b><br>${where(x)}${spec.x.si ? " steps" : ""}: ${shown(y)}`
        + (one.low ? ` [${shown(one.low[k])}, ${shown(one.high[k])}]` : "");
      if (one.low && !one.bars && (one.band ?? !one.flat)) {
        traces.push({
          x: [...one.x, ...[...one.x].reverse()], y: [...one.high, ...[...one.low].reverse()],
          fill: "toself", fillcolor: faint(color, 0.11), line: { width: 0 }, mode: "lines", hoverinfo: "skip",
        });
      }
      for (const run of one.runs || []) {
        // Of unfinished runs nothing else is shown; they end in a cross.
        if (state.runs || run.open) {
          traces.push({
            x: run.x, y: run.y, mode: "lines+markers", opacity: run.open ? 0.8 : 0.5,
            line: { color, width: run.open ? 1.4 : 1, dash: run.open ? "dot" : "solid" },
            marker: run.open
              ? { color, size: run.y.map((_, k) => (k + 1 < run.y.length ? 3 : 8)), symbol: run.y.map((_, k) => (k + 1 < run.y.length ? "circle" : "x-thin-open")), line: { color, width: 1.6 } }
              : { color, size: 3 },
            text: run.y.map((y, k) => `<b>${name}</b>, ${safe(run.name)}<br>${where(run.x[k])} steps: ${shown(y)}`),
            hovertemplate: "%{text}<extra></extra>",
          });
        }
      }
      traces.push({
        x: one.x, y: one.y, mode: one.flat || !one.symbol ? "lines" : "lines+markers",
        line: { color, width: one.flat ? 1.8 : 2.2, dash: one.dash || "solid" },
        marker: { color, size: 7, symbol: one.symbol || undefined },
        error_y: one.bars ? {
          type: "data", symmetric: false, color, thickness: 1, width: 3,
          array: one.high.map((h, k) => h - one.y[k]), arrayminus: one.low.map((l, k) => one.y[k] - l),
        } : undefined,
        text: one.y.map((y, k) => label(one.x[k], y, k)),
        hovertemplate: "%{text}<extra></extra>",
      });
      if (one.returns?.y.length) {
        traces.push({
          x: one.returns.x, y: one.returns.y, mode: "markers",
          marker: { color, size: 7, symbol: "circle-open", line: { width: 1.6 } },
          text: one.returns.y.map((y, k) => `<b>${name}</b>, fresh return<br>${where(one.returns.x[k])} steps: ${shown(y)}`),
          hovertemplate: "%{text}<extra></extra>",
        });
      }
    });
    const shapes = spec.band ? [{
      type: "rect", xref: "paper", x0: 0, x1: 1, y0: spec.band.low, y1: spec.band.high, layer: "below",
      fillcolor: isDark() ? "#2c3a24" : "#e8f0dc", line: { width: 1, color: isDark() ? "#5b7a3c" : "#a9c284" },
    }] : [];
    return { traces, layout: { shapes } };
  };

  const points = (spec, state) => {
    const traces = [];
    spec.series.forEach((one, index) => {
      if (state.hidden.has(index)) return;
      const color = colorOf(one);
      for (const line of one.lines) {
        traces.push({
          x: [...line.x, ...[...line.x].reverse()], y: [...line.high, ...[...line.low].reverse()],
          fill: "toself", fillcolor: faint(color, 0.1), line: { width: 0 }, mode: "lines", hoverinfo: "skip",
        });
        traces.push({ x: line.x, y: line.y, mode: "lines", line: { color, width: 1.6 }, hoverinfo: "skip" });
      }
      const arms = (axis) => ({
        type: "data", symmetric: false, color, thickness: 1, width: 0,
        array: one.points.map((p) => Math.max(0, p[`${axis}high`] - p[axis])),
        arrayminus: one.points.map((p) => Math.max(0, p[axis] - p[`${axis}low`])),
      });
      traces.push({
        x: one.points.map((p) => p.x), y: one.points.map((p) => p.y), mode: "markers",
        marker: {
          size: 9, color: one.points.map((p) => (p.hollow ? css("--raised") : color)),
          symbol: one.symbol, line: { color, width: 1.6 },
        },
        error_x: arms("x"), error_y: arms("y"),
        text: one.points.map((p) => `<b>${safe(one.name)}</b><br>${safe(p.name)}<br>${safe(p.text)}`),
        hovertemplate: "%{text}<extra></extra>",
      });
    });
    return { traces, layout: {} };
  };

  const bars = (spec, state) => {
    const traces = spec.series.map((one, index) => {
      const color = colorOf(one);
      return {
        visible: !state.hidden.has(index),
        x: one.points.map((p) => p.x), y: one.points.map((p) => -p.at + (index ? 0.16 : -0.04)), mode: "markers",
        marker: { size: index ? 9 : 10, color, symbol: one.symbol || "circle" },
        error_x: {
          type: "data", symmetric: false, color, thickness: index ? 1 : 2, width: 0,
          array: one.points.map((p) => p.xhigh - p.x), arrayminus: one.points.map((p) => p.x - p.xlow),
        },
        text: one.points.map((p) => `<b>${safe(spec.names[p.at])}</b><br>${safe(p.text)}`),
        hovertemplate: "%{text}<extra></extra>",
      };
    });
    const narrow = innerWidth < 620;
    const fold = (name) => (narrow && name.length > 22 ? name.replace(/^(\S+ \S+) /, "$1\n") : name);
    const ticks = spec.names.map((name) => safe(fold(name)).replace("\n", "<br>"));
    const yaxis = {
      tickvals: spec.names.map((_, i) => -i), ticktext: ticks, range: [-spec.names.length + 0.4, 0.6],
      automargin: true, zeroline: false, gridcolor: css("--line"), tickfont: { size: narrow ? 10 : 12, color: css("--text") },
    };
    return { traces, layout: { yaxis, height: 90 + spec.names.length * (narrow ? 38 : 30) } };
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
    const yaxis = { ...axisOf({ title: "environment steps" }), type: "category", autorange: "reversed", nticks: undefined, showgrid: false };
    return { traces, layout: { xaxis: { ...axisOf({ title: "held-out episodes" }), showgrid: false }, yaxis, height: 110 + 24 * spec.rows.length } };
  };

  const KINDS = { curves, points, bars, episodes };

  const draw = (figure) => {
    const { spec, state, plot } = figure;
    const { traces, layout } = KINDS[spec.kind](spec, state);
    const full = {
      font: { family: css("--sans"), size: 13, color: css("--text") },
      paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      margin: { l: 48, r: 12, t: 8, b: 44 }, showlegend: false, hovermode: "closest",
      hoverlabel: { bgcolor: css("--bg"), bordercolor: css("--muted"), font: { family: css("--sans"), size: 13, color: css("--text") }, align: "left" },
      ...(spec.x ? { xaxis: axisOf(spec.x) } : {}), ...(spec.y ? { yaxis: axisOf(spec.y) } : {}),
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
    const color = colorOf(series);
    if (series.dash) add("line", { x1: 0, x2: 30, y1: 6, y2: 6, stroke: color, "stroke-width": 2.4, "stroke-dasharray": dashes[series.dash] || "none" });
    const shape = { square: "M11 2h8v8h-8z", diamond: "M15 1l5 5-5 5-5-5z", "triangle-up": "M15 1l5 9H10z", "triangle-down": "M15 11l5-9H10z", x: "M11 2l8 8M19 2l-8 8", cross: "M15 1v10M10 6h10" }[series.symbol?.replace("-open", "")];
    const fill = series.symbol?.endsWith("open") ? css("--raised") : color;
    if (shape) add("path", { d: shape, fill, stroke: color, "stroke-width": 1.5 });
    else if (series.symbol) add("circle", { cx: 15, cy: 6, r: 3.6, fill, stroke: color, "stroke-width": 1.5 });
    return svg;
  };

  const legend = (figure) => {
    const { spec, state, box } = figure;
    if (!spec.series || (spec.series.length < 2 && !spec.series[0]?.returns)) return;
    const button = (text, pressed, mark, toggle) => {
      const made = document.createElement("button");
      made.type = "button";
      made.setAttribute("aria-pressed", String(pressed));
      if (mark) made.append(mark);
      const label = document.createElement("span");
      label.textContent = text;
      made.append(label);
      made.addEventListener("click", () => { toggle(); legend(figure); draw(figure); });
      return made;
    };
    const focused = [...box.children].indexOf(document.activeElement);
    box.replaceChildren(...spec.series.map((one, index) => button(one.name, !state.hidden.has(index), swatch(one), () => {
      state.hidden.has(index) ? state.hidden.delete(index) : state.hidden.add(index);
    })));
    if (spec.series.some((one) => one.runs?.length)) {
      const runs = button("single runs", state.runs, null, () => { state.runs = !state.runs; });
      runs.className = "runs";
      box.append(runs);
    }
    if (focused >= 0) box.children[focused].focus();
  };

  const figures = new Map();
  const seen = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      if (!entry.isIntersecting) continue;
      seen.unobserve(entry.target);
      const figure = figures.get(entry.target);
      figure.drawn = true;
      legend(figure);
      draw(figure);
    }
  }, { rootMargin: "400px" });

  const start = () => {
    if (globalThis.SymSteerTables) {
      // Errors of a table go to the console; a reader is not stopped by a dialogue.
      SymSteerTables.default.ext.errMode = "throw";
      document.querySelectorAll("table.data, .sortable table").forEach(makeTable);
    }
    for (const element of document.querySelectorAll("figure.chart")) {
      const spec = JSON.parse(element.querySelector("script[type='application/json']").textContent);
      figures.set(element, {
        spec, drawn: false,
        // Beside the bands of many agents, single runs hide more than they show.
        state: { hidden: new Set(), runs: !spec.series || spec.series.filter((one) => one.low && !one.flat).length < 3 },
        plot: element.querySelector(".plot"), box: element.querySelector(".legend"),
      });
      seen.observe(element);
    }
    document.addEventListener("themechange", () => {
      for (const figure of figures.values()) if (figure.drawn) { legend(figure); draw(figure); }
    });
    for (const button of document.querySelectorAll("[data-copy]")) {
      button.addEventListener("click", async () => {
        const text = document.getElementById(button.dataset.copy).textContent;
        try {
          await navigator.clipboard.writeText(text);
          button.textContent = "Copied";
        } catch {
          getSelection().selectAllChildren(document.getElementById(button.dataset.copy));
          button.textContent = "Selected";
        }
      });
    }
    root.classList.add("ready");
  };
  start();
})();
