// A sweep: which settings are best, medians and interquartile ranges over seeds, and what to show.

const MEASURES = [
  { key: "hypervolume", title: "hypervolume" },
  { key: "best_regularity", title: "best R" },
  { key: "best_improvement_potential", title: "best P" },
  { key: "knee_regularity", title: "R of the knee" },
  { key: "knee_improvement_potential", title: "P of the knee" },
  { key: "seconds", title: "seconds", down: true },
];

/** The name of a measure for the runs on the mesh that is shown, which searched one and the same potential. */
const titleOf = ({ title }, state) => title.replace(/\bP\b/, runShown(state).symbol);

function drawAnswers(state) {
  const { sweep } = state.content;
  if (!sweep) return;
  byId("answers").hidden = false;
  byId("sentences").replaceChildren(...sweep.sentences.map(answer), ...sweep.warnings.map((warning) => el("li", { class: "hint" }, `Warning: ${warning}`)));
  byId("measure").replaceChildren(...MEASURES.map(({ key }) => el("option", { value: key })));
  byId("measure").addEventListener("change", () => drawSpread(state));
  state.groupSort = { key: "hypervolume", down: true };
}

/** A sentence: its first clause, and how certain it is. */
function answer(sentence) {
  const [first, ...more] = sentence.split("; ");
  return el("li", {}, el("b", {}, first), more.length ? el("span", { class: "hint" }, `; ${more.join("; ")}`) : null);
}

/** The groups on the mesh that is shown. */
const groupsShown = (state) => state.content.sweep.groups.filter((group) => group.mesh === state.meshIndex);

/** A label in lines of at most about `most` letters. */
function wrapped(name, most) {
  const lines = [""];
  for (const part of name.split(", ")) {
    if (lines.at(-1) && lines.at(-1).length + part.length > most) lines.push("");
    lines.push(`${lines.at(-1) ? `${lines.pop()}, ` : lines.pop()}${part}`);
  }
  return lines.join("<br>");
}

/** A dot for every seed, and median and quartiles for every group, the best on top. */
function drawSpread(state) {
  for (const option of byId("measure").options) option.textContent = titleOf(MEASURES.find((measure) => measure.key === option.value), state);
  const colors = theme(), key = byId("measure").value, { down } = MEASURES.find((measure) => measure.key === key);
  const groups = groupsShown(state).filter((group) => group[key].median !== null);
  groups.sort((a, b) => (down ? b[key].median - a[key].median : a[key].median - b[key].median));
  const names = groups.map((group) => group.label), plot = byId("spread"), narrow = plot.clientWidth < 640;
  const cut = (name) => wrapped(name, narrow ? 22 : 60), lines = Math.max(1, ...names.map((name) => cut(name).split("<br>").length));
  const traces = [
    { type: "scatter", mode: "markers", name: "each seed", y: groups.flatMap((group) => group[key].values.map(() => group.label)), x: groups.flatMap((group) => group[key].values), text: groups.flatMap((group) => group.runs), hovertemplate: "%{text}: %{x:.5g}<extra></extra>", marker: { color: colors.grey, size: 6, opacity: 0.6 } },
    { type: "scatter", mode: "markers", name: "median, first and third quartile", y: names, x: groups.map((group) => group[key].median), hovertemplate: "%{y}<br>median %{x:.5g}<extra></extra>", marker: { color: colors.accent, symbol: "line-ns", size: 16, line: { width: 3, color: colors.accent } }, error_x: { type: "data", symmetric: false, array: groups.map((group) => group[key].third - group[key].median), arrayminus: groups.map((group) => group[key].median - group[key].first), color: colors.accent, thickness: 3, width: 0 } },
  ];
  const layout = {
    height: 120 + (10 + 16 * lines) * names.length, margin: { l: 10, r: 16, t: 10, b: 44 }, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", font: { color: colors.ink, size: 12 }, dragmode: false, hovermode: "closest",
    hoverlabel: { bgcolor: colors.paper, bordercolor: colors.grey, font: { color: colors.ink } }, legend: { orientation: "h", y: 1.02, yanchor: "bottom", x: 0 },
    xaxis: { ...axisLook(colors), title: { text: titleOf(MEASURES.find((measure) => measure.key === key), state) } }, yaxis: { ...axisLook(colors), type: "category", categoryarray: names, tickvals: names, ticktext: names.map(cut) },
  };
  Plotly.react(plot, traces, layout, CONFIG);
}

function drawGroups(state) {
  const columns = [{ key: "label", title: "settings", text: true }, { key: "seeds", title: "seeds" }, ...MEASURES.map((measure) => ({ ...measure, title: titleOf(measure, state) }))];
  const value = (group, key) => (key === "label" || key === "seeds" ? group[key] : group[key].median);
  const { groupSort: sort } = state, groups = groupsShown(state).sort((a, b) => compare(value(a, sort.key), value(b, sort.key), sort.down));
  const act = (key) => { state.groupSort = sortedBy(sort, columns.find((column) => column.key === key)); drawGroups(state); byId("groups").querySelector(`[data-key="${key}"]`).focus(); };
  const cell = ({ median, first, third }) => (median === null ? "–" : `${short(median)} [${short(first)}, ${short(third)}]`);
  byId("groups").replaceChildren(sortingHead(columns, sort, act), el("tbody", {}, ...groups.map((group) =>
    el("tr", {}, el("td", { class: "text" }, group.label), el("td", {}, String(group.seeds)), ...MEASURES.map(({ key }) => el("td", {}, cell(group[key])))))));
}

/** Selects for the mesh, for every setting that differs, and for the setting that the colours of the front show. */
function drawFilters(state) {
  const { sweep, meshes } = state.content;
  if (!sweep) return;
  byId("filters").hidden = false;
  const row = byId("filter-row"), boxes = [];
  if (meshes.length > 1) {
    const choices = meshes.map((mesh, index) => el("option", { value: index }, sweep.meshes[index]));
    boxes.push(el("label", {}, "mesh ", el("select", { id: "filter-mesh", on: { change: (event) => state.showMesh(Number(event.target.value)) } }, ...choices)));
  }
  for (const name of sweep.varying) {
    const values = state.settingValues.get(name);
    boxes.push(el("label", {}, `${name} `, el("select", { "data-setting": name, on: { change: (event) => state.filter(name, event.target.value) } }, el("option", { value: "" }, "all"), ...values.map((value) => el("option", { value }, value)))));
  }
  boxes.push(el("label", {}, "colour by ", el("select", { id: "color-by", on: { change: (event) => { state.colorBy = event.target.value || null; drawFront(state); } } },
    ...sweep.varying.map((name) => el("option", { value: name }, name)), el("option", { value: "" }, "kind of setup"))));
  row.replaceChildren(...boxes);
  state.colorBy = sweep.varying[0] || null;
}
