// The state of the page, and what changes it.

function start() {
  Plotly.setPlotConfig({ logging: 0 }); // it logs every turn of an orthographic view as an edit that it does not know
  const content = JSON.parse(byId("content").textContent), setups = setupsOf(content);
  content.meshes.forEach(unpackMesh);
  const state = {
    content, setups, several: content.runs.length > 1 || Boolean(content.sweep), meshIndex: 0, mesh: content.meshes[0], visible: [], front: [], inFront: new Set(), knee: null, chosen: null, kept: null,
    color: "wanted", shape: "template", seeThrough: false, logarithmic: content.logarithmic, sort: { key: "row", down: false }, shownRows: AT_ONCE, filters: {}, filterKey: "", colorBy: null, camera: null, sides: null, settingValues: new Map(),
  };
  for (const name of content.sweep?.varying || []) state.settingValues.set(name, [...new Set(content.runs.map((run) => settingOf(run, name)))].sort((a, b) => a.localeCompare(b, "en", { numeric: true })));

  /** What the filters leave, its front and its knee. */
  function refresh() {
    state.visible = setups.filter((setup) => setup.run.mesh === state.meshIndex && Object.entries(state.filters).every(([name, value]) => !value || settingOf(setup.run, name) === value));
    state.front = frontOf(state.visible, !state.several);
    state.inFront = new Set(state.front);
    state.knee = kneeOf(state.front);
    state.filterKey = JSON.stringify([state.meshIndex, state.filters]);
  }

  state.choose = (setup, by) => {
    if (!setup) return;
    state.chosen = setup;
    if (by === "slider") showPreference(Number(byId("preference").value));
    else placeSlider();
    if (by !== "start") moveRings(state);
    drawViews();
    drawTexts();
    markRows(state, by !== "table");
    remember();
    if (by !== "start") byId("announce").textContent = `${origin(setup, state.several)}: ${scores(setup)}`;
  };

  state.filter = (name, value) => { state.filters[name] = value; show(); };
  state.showMesh = (index) => {
    if (index !== state.meshIndex) state.camera = state.sides = null;
    state.meshIndex = index;
    state.mesh = content.meshes[index];
    if (byId("filter-mesh")) byId("filter-mesh").value = index;
    show();
    if (content.sweep) { drawNumbers(state); drawSpread(state); drawGroups(state); }
  };

  function show() {
    refresh();
    const none = !state.visible.length;
    byId("nothing").hidden = !none;
    document.querySelector("main").classList.toggle("nothing", none);
    if (none) return;
    if (!state.visible.includes(state.chosen)) state.chosen = state.knee || state.visible[0];
    drawObjectives();
    if (state.kept?.run.mesh !== state.meshIndex) state.kept = null;
    drawFront(state);
    drawTable(state);
    byId("preference").step = Math.min(0.01, 1 / Math.max(1, state.front.length - 1));
    state.choose(state.chosen, "start");
  }

  function drawViews() {
    const both = Boolean(state.kept);
    byId("views").classList.toggle("two", both);
    byId("view-b").hidden = !both;
    byId("swap").hidden = !both;
    byId("keep").setAttribute("aria-pressed", String(both));
    byId("keep").firstChild.textContent = both ? "Drop the kept setup " : "Keep to compare ";
    byId("caption-a").textContent = `${both ? "Chosen: " : ""}${origin(state.chosen, state.several)}: ${scores(state.chosen)}`;
    byId("caption-b").textContent = both ? `Kept: ${origin(state.kept, state.several)}: ${scores(state.kept)}` : "";
    drawScale(state);
    drawing(() => {
      drawView(state, "a", state.chosen);
      if (both) drawView(state, "b", state.kept);
    });
  }

  let waiting = null;
  /** Draw once for all that changes within a frame, so that the slider stays ahead of the views. */
  function drawing(act) {
    if (waiting === null) requestAnimationFrame(() => setTimeout(() => { const now = waiting; waiting = null; now(); }));
    waiting = act;
  }

  /** Radio buttons for several objectives of the mesh that is shown. */
  function drawObjectives() {
    const { fields, objective } = state.mesh, several = fields.length > 1;
    byId("objectives").hidden = !several;
    byId("objective-key").hidden = byId("objective-key").nextElementSibling.hidden = !content.meshes.some((mesh) => mesh.fields.length > 1);
    byId("objective-choices").replaceChildren(...(several ? fields : []).map(({ name }, index) =>
      el("label", {}, el("input", { type: "radio", name: "objective", value: index, checked: index === objective, on: { change: () => setObjective(index) } }), ` ${name}`)));
  }

  function setObjective(index) {
    const { fields } = state.mesh;
    if (fields.length < 2) return;
    showObjective(state.mesh, index % fields.length);
    document.querySelector(`input[name="objective"][value="${state.mesh.objective}"]`).checked = true;
    drawViews();
    remember();
    byId("announce").textContent = `objective ${state.mesh.name}`;
  }

  function drawTexts() {
    const cards = [card(state.chosen, state.mesh, state.kept ? "The chosen setup" : "This setup", state.several)];
    if (state.kept) {
      cards.push(card(state.kept, state.mesh, "The kept setup", state.several));
      cards[1].style.borderColor = "var(--accent)";
    }
    byId("cards").replaceChildren(...cards);
    byId("next").replaceChildren(...(state.kept ? [el("p", {}, comparison(state.chosen, state.kept))] : []), nextSteps(state.chosen, state.mesh));
    if (drawTexts.run !== state.chosen.run) byId("made-details").replaceChildren(madeDetails(state.chosen.run));
    drawTexts.run = state.chosen.run;
  }

  /** Put the slider where it would choose this setup, if there is such a place. */
  function placeSlider() {
    const range = preferencesOf(state.chosen, state.visible), at = state.front.indexOf(state.chosen);
    const along = at < 0 ? null : state.front.length > 1 ? at / (state.front.length - 1) : 0.5;
    const place = byId("weighted").checked ? range && (range[0] + range[1]) / 2 : along;
    if (place !== null) byId("preference").value = place;
    showPreference(place);
  }

  function showPreference(place) {
    byId("preference-value").textContent = place === null ? "none" : place.toFixed(2);
    byId("preference-value").title = place === null ? "no position of the slider selects this setup" : "";
    byId("preference").setAttribute("aria-valuetext", `${place === null ? "none" : place.toFixed(2)}: ${origin(state.chosen, state.several)}, ${scores(state.chosen)}`);
    const range = preferencesOf(state.chosen, state.visible);
    const formula = range ? `best for preferences ${range[0].toFixed(3)} to ${range[1].toFixed(3)} of the command line` : "best for no preference of the command line (it lies in a concave part of the front, or is dominated)";
    byId("preference-hint").textContent = `This setup is ${formula}. ${byId("weighted").checked ? "The slider weighs both scores and skips concave parts of the front." : "The slider moves along the front, one nondominated setup at a time."}`;
  }

  function slide() {
    const place = Number(byId("preference").value);
    const found = byId("weighted").checked ? preferred(state.visible, place) : alongFront(state.front, place);
    showPreference(place);
    if (found !== state.chosen) state.choose(found, "slider");
  }

  function walk(steps) {
    const at = state.front.indexOf(state.chosen);
    const nearest = () => state.front.reduce((best, setup, index) => (Math.hypot(setup.R - state.chosen.R, setup.P - state.chosen.P) < Math.hypot(state.front[best].R - state.chosen.R, state.front[best].P - state.chosen.P) ? index : best), 0);
    state.choose(state.front[at < 0 ? nearest() : Math.max(0, Math.min(state.front.length - 1, at + steps))], "walk");
  }

  function keep() {
    state.kept = state.kept ? null : state.chosen;
    changedPair(state.kept ? "kept for comparison" : "comparison closed");
  }

  function swap() {
    if (!state.kept) return;
    [state.chosen, state.kept] = [state.kept, state.chosen];
    placeSlider();
    changedPair("swapped");
  }

  function changedPair(change) {
    moveRings(state);
    drawViews();
    drawTexts();
    markRows(state, false);
    remember();
    byId("announce").textContent = change;
  }

  function setRadio(name, value) {
    state[name] = value;
    document.querySelector(`input[name="${name}"][value="${value}"]`).checked = true;
    drawViews();
  }

  function fileName(ending) {
    const run = state.several ? `${state.chosen.run.name.replace(/[^A-Za-z0-9._-]+/g, "-")}-` : "";
    return `${run}row-${state.chosen.row}${ending}`;
  }

  const saveCenters = () => save(new Blob([centersCsv(state.chosen, state.mesh)], { type: "text/csv" }), fileName("-centers.csv"));

  async function savePicture() {
    try {
      save(await pictureOf(state), fileName(".png"));
    } catch (error) {
      byId("announce").textContent = `The picture could not be saved: ${error.message || error}`;
    }
  }

  /** The choice in the address, so that a link or a reload finds it again. */
  function remember() {
    const name = (setup) => `${state.several ? `${encodeURIComponent(setup.run.name)}:` : ""}${setup.row}`;
    const shown = state.mesh.objective ? `&objective=${encodeURIComponent(state.mesh.name)}` : "";
    const address = `#setup=${name(state.chosen)}${state.kept ? `&kept=${name(state.kept)}` : ""}${shown}`;
    try { history.replaceState(null, "", address); } catch { /* some browsers refuse it for files */ }
  }

  function remembered() {
    const choice = new URLSearchParams(location.hash.slice(1));
    const find = (label) => {
      if (label === null) return null;
      const [row, ...name] = label.split(":").reverse();
      const run = name.reverse().join(":");
      return setups.find((setup) => String(setup.row) === row && (!state.several || setup.run.name === run)) || null;
    };
    state.chosen = find(choice.get("setup"));
    state.kept = find(choice.get("kept"));
    for (const mesh of content.meshes) showObjective(mesh, Math.max(0, mesh.fields.findIndex(({ name }) => name && name === choice.get("objective"))));
  }

  const keys = {
    k: () => state.choose(state.knee, "key"),
    r: () => state.choose(bestOf(state.visible, "R", "P"), "key"),
    p: () => state.choose(bestOf(state.visible, "P", "R"), "key"),
    ArrowLeft: () => walk(-1),
    ArrowRight: () => walk(1),
    c: keep,
    x: swap,
    e: () => setRadio("color", state.color === "wanted" ? "left" : "wanted"),
    t: () => { const shapes = ["template", "reached", "wanted"]; setRadio("shape", shapes[(shapes.indexOf(state.shape) + 1) % 3]); },
    n: () => setObjective(state.mesh.objective + 1),
    o: () => { byId("see-through").checked = state.seeThrough = !state.seeThrough; drawViews(); },
    v: () => turnBack(state),
    d: saveCenters,
    s: savePicture,
    "?": () => byId("keys").showModal(),
  };

  document.addEventListener("keydown", (event) => {
    const letter = event.key.length === 1, act = keys[letter ? event.key.toLowerCase() : event.key], inside = event.target.closest?.("input:not([type=radio]):not([type=checkbox]), select, textarea, dialog, .scroll");
    const arrows = event.key.startsWith("Arrow") && event.target.closest?.("input, select, .scroll");
    if (!act || (letter && !byId("letters").checked) || event.ctrlKey || event.metaKey || event.altKey || arrows || (inside && inside.matches("select, textarea, dialog"))) return;
    event.preventDefault();
    act();
  });
  for (const [id, key] of [["knee", "k"], ["best-regularity", "r"], ["best-potential", "p"], ["walk-left", "ArrowLeft"], ["walk-right", "ArrowRight"], ["keep", "c"], ["swap", "x"], ["save-centers", "d"], ["save-picture", "s"], ["turn-back", "v"], ["keys-button", "?"]]) byId(id).addEventListener("click", () => keys[key]());
  byId("preference").addEventListener("input", slide);
  byId("weighted").addEventListener("change", placeSlider);
  byId("logarithmic").checked = state.logarithmic;
  byId("logarithmic").addEventListener("change", (event) => { state.logarithmic = event.target.checked; drawFront(state); });
  byId("see-through").addEventListener("change", (event) => { state.seeThrough = event.target.checked; drawViews(); });
  for (const input of document.querySelectorAll('input[name="color"], input[name="shape"]')) input.addEventListener("change", () => setRadio(input.name, input.value));
  byId("only-front").addEventListener("change", () => drawTable(state));
  byId("more").addEventListener("click", () => { state.shownRows += AT_ONCE; drawTable(state); });
  byId("copy-bibtex").addEventListener("click", () => copyText(byId("bibtex").textContent, byId("copy-bibtex")));
  addEventListener("hashchange", () => { remembered(); state.showMesh(state.chosen ? state.chosen.run.mesh : state.meshIndex); });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { drawFront(state); drawViews(); if (content.sweep) { drawNumbers(state); drawSpread(state); } });

  if (!document.createElement("canvas").getContext("webgl")) state.flaw = "This browser has no WebGL, or it is switched off: the 3-D views stay empty, but the front, the table and the CSV work. ";
  const fitting = new ResizeObserver((changes) => changes.forEach(({ target }) => { if (target.data && target.clientWidth) Plotly.Plots.resize(target); }));
  for (const id of ["front", "space-a", "space-b", "spread", "numbers-potential", "numbers-regularity"]) fitting.observe(byId(id));

  byId("title").textContent = content.title;
  byId("subtitle").textContent = content.subtitle;
  byId("bibtex").textContent = bibtex(content.version);
  if (content.meshes.every((mesh) => mesh.k !== 1 && mesh.k !== 3)) byId("shapes").hidden = true;
  if (content.sweep) {
    byId("only-front").checked = true;
    state.sort = { key: "R", down: true };
  }
  remembered();
  drawFilters(state);
  drawAnswers(state);
  state.showMesh(state.chosen ? state.chosen.run.mesh : 0);
  window.rbfevo = { state, leftOf, frontOf, nondominated, kneeOf, bestOf, preferred, preferencesOf, alongFront }; // for the browser's console, and for tests
  document.documentElement.dataset.ready = "yes";
}

try {
  start();
} catch (error) {
  byId("problem").hidden = false;
  byId("problem").textContent = `This page could not be drawn (${error.message}). Try a newer browser, or see front.png and centers.png in the same directory.`;
  throw error;
}
