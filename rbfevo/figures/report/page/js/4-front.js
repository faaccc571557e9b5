// The front: every setup's improvement potential over its regularity.

/** The colours of the page as they are now, bright or dark. */
function theme() {
  const style = getComputedStyle(document.documentElement), read = (name) => style.getPropertyValue(`--${name}`).trim();
  const names = ["paper", "panel", "ink", "grey", "line", "accent", "center", "image", "clay"];
  return { ...Object.fromEntries(names.map((name) => [name, read(name)])), dark: matchMedia("(prefers-color-scheme: dark)").matches };
}

const QUALITATIVE = ["#0b4fa8", "#f28e00", "#57b55a", "#d3148f", "#7a5cc4", "#008c95", "#a3591f", "#6b6b6b"];
const QUALITATIVE_ON_DARK = ["#6aa5f5", "#ffa733", "#6fcf72", "#ff66bd", "#b39df0", "#3fc6cf", "#d99a63", "#a8a8a8"];

/** Settings that every plot of the page shares: no buttons of the library, and no data sent anywhere. */
const CONFIG = { responsive: false, displaylogo: false, displayModeBar: false, plotlyServerURL: "", showSendToCloud: false, showLink: false };

const touched = () => matchMedia("(pointer: coarse)").matches;
/** Of the front alone: zoom and back. */
const ZOOMING = () => ({ ...CONFIG, displayModeBar: touched() ? false : "hover", modeBarButtons: [["zoom2d", "pan2d", "resetScale2d"]] });

function axisLook(colors) {
  return { gridcolor: colors.line, zerolinecolor: colors.line, linecolor: colors.grey, tickcolor: colors.grey, color: colors.ink, automargin: true };
}

/** Where setups of regularity 0 stand on a logarithmic axis, and where that axis ends. */
function logScale(setups) {
  const positive = setups.map((setup) => setup.R).filter((R) => R > 0);
  const low = positive.length ? Math.min(...positive) : 0.1, high = positive.length ? Math.max(...positive) : 1;
  const decades = Math.max(Math.log10(high / low), 0.1), zeros = positive.length < setups.length;
  return { zeros, zero: low * 10 ** (-0.09 * decades), low: low * 10 ** ((zeros ? -0.14 : -0.04) * decades), high: high * 10 ** (0.04 * decades), edge: low * 10 ** (-0.045 * decades) };
}

/** Data and layout of the front for the state of the page. */
function frontFigure(state) {
  const colors = theme(), setups = state.visible, log = state.logarithmic, scale = logScale(setups);
  const place = (setup) => (log && !(setup.R > 0) ? scale.zero : setup.R);
  const label = (setup) => `${origin(setup, state.several)}<br>R ${short(setup.R)} · ${setup.run.symbol} ${short(setup.P)}${setup.each.length ? `<br>${setup.run.objectives.symbol}: ${eachOf(setup).join(" · ")}` : ""}`;
  const traces = [];
  const lowest = log ? scale.low : Math.min(...setups.map((setup) => setup.R)), bottom = Math.min(...setups.map((setup) => setup.P));
  if (state.front.length) {
    const steps = state.front.map((setup) => [place(setup), setup.P]);
    traces.push({ type: "scatter", mode: "lines", x: [lowest, ...steps.map((s) => s[0]), steps.at(-1)[0]], y: [steps[0][1], ...steps.map((s) => s[1]), bottom], line: { shape: "vh", color: colors.accent, width: 1 }, opacity: 0.45, hoverinfo: "skip", showlegend: false });
  }
  for (const group of groupsOf(state)) {
    const members = group.members;
    traces.push({
      type: "scatter", mode: "markers", name: group.label, x: members.map(place), y: members.map((setup) => setup.P), customdata: members.map((setup) => setup.index),
      text: members.map(label), hovertemplate: "%{text}<extra></extra>", cliponaxis: false,
      marker: { color: group.color, symbol: group.symbol, size: group.size, line: { color: group.symbol.endsWith("-open") ? group.color : colors.panel, width: group.symbol.endsWith("-open") ? 1.3 : 0.6 } },
    });
  }
  const ring = (setup, name, color, size, width) => ({ type: "scatter", mode: "markers", name, x: setup ? [place(setup)] : [], y: setup ? [setup.P] : [], hoverinfo: "skip", cliponaxis: false, showlegend: name === "knee" && Boolean(setup), marker: { symbol: "circle-open", size, color, line: { color, width } } });
  traces.push(ring(state.knee, "knee", colors.ink, 15, 1.2), ring(state.kept, "kept", colors.accent, 20, 3), ring(state.chosen, "chosen", colors.center, 20, 3));
  const narrow = byId("front").clientWidth < 520, run = runShown(state);
  const layout = {
    uirevision: `${state.filterKey} ${log}`, margin: { l: 56, r: 12, t: 30, b: 44 }, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", font: { color: colors.ink, size: 12 }, hovermode: "closest", dragmode: touched() ? false : "zoom",
    hoverlabel: { bgcolor: colors.paper, bordercolor: colors.grey, font: { color: colors.ink } },
    legend: { orientation: "h", yref: "container", y: 0, yanchor: "bottom", x: 0, font: { size: narrow ? 10 : 12 } }, // the buttons are above
    xaxis: { ...axisLook(colors), title: { text: `regularity R${log ? " (logarithmic)" : ""} →` }, type: log ? "log" : "linear", zeroline: false, ...(log ? { range: [Math.log10(scale.low), Math.log10(scale.high)], exponentformat: "power", dtick: 1 } : {}) },
    yaxis: { ...axisLook(colors), title: { text: `${run.potential_name}${run.bounded || run.objectives ? "" : " P"} →` }, zeroline: false },
    shapes: log && scale.zeros ? [{ type: "rect", xref: "x", yref: "paper", x0: scale.low, x1: scale.edge, y0: 0, y1: 1, fillcolor: colors.line, opacity: 0.4, line: { width: 0 }, layer: "below" }] : [],
    annotations: log && scale.zeros ? [{ x: Math.log10(scale.zero), y: 0, xref: "x", yref: "paper", text: "R = 0", showarrow: false, yanchor: "bottom", font: { size: 11, color: colors.grey } }] : [],
  };
  return { traces, layout };
}

/** The visible setups in groups of one look: by series for a run, by a setting for a sweep. */
function groupsOf(state) {
  const colors = theme(), groups = new Map();
  for (const setup of state.visible) {
    const series = state.content.series[setup.series], setting = state.colorBy ? settingOf(setup.run, state.colorBy) : null;
    const label = setting === null ? series.label : `${setting}`;
    if (!groups.has(label)) groups.set(label, { label, symbol: series.symbol, size: setting === null ? series.size : 7, color: colors.dark ? series.dark : series.color, order: setting === null ? series.order : 0, members: [] });
    groups.get(label).members.push(setup);
  }
  const found = [...groups.values()];
  if (!state.colorBy) return found.sort((a, b) => a.order - b.order);
  const values = state.settingValues.get(state.colorBy), palette = colors.dark ? QUALITATIVE_ON_DARK : QUALITATIVE;
  for (const group of found) { const which = values.indexOf(group.label); group.color = palette[which % palette.length]; group.order = which; group.symbol = ["circle", "square", "diamond", "triangle-up"][Math.floor(which / palette.length) % 4]; }
  return found.sort((a, b) => a.order - b.order);
}

/** A setting of a run, as text. */
function settingOf(run, name) {
  const value = run.settings[name];
  return value === null || value === undefined ? "–" : typeof value === "number" ? short(value) : String(value);
}

function drawFront(state) {
  const { traces, layout } = frontFigure(state), plot = byId("front");
  Plotly.react(plot, traces, layout, ZOOMING());
  const { potential_name } = runShown(state);
  plot.setAttribute("aria-label", `${potential_name[0].toUpperCase()}${potential_name.slice(1)} over regularity of every setup`);
  if (!plot.dataset.listens) {
    plot.dataset.listens = "yes";
    plot.on("plotly_click", (event) => {
      const point = event.points.find((found) => found.customdata !== undefined);
      if (point) state.choose(state.setups[point.customdata], "click");
    });
  }
}

/** Move the rings only: the rest of the front stays as it is. */
function moveRings(state) {
  const plot = byId("front"), count = plot.data.length, scale = logScale(state.visible);
  const place = (setup) => (setup ? [state.logarithmic && !(setup.R > 0) ? scale.zero : setup.R] : []);
  const potential = (setup) => (setup ? [setup.P] : []);
  Plotly.restyle(plot, { x: [place(state.kept), place(state.chosen)], y: [potential(state.kept), potential(state.chosen)] }, [count - 2, count - 1]);
}
