// Texts: the meaning of the scores of a setup, how its run was made, and the commands to continue.

/** An element with attributes, and children that are elements or text. */
function el(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key === "on") for (const [event, act] of Object.entries(value)) made.addEventListener(event, act);
    else if (value !== null && value !== false) made.setAttribute(key, value === true ? "" : value);
  }
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}

const byId = (id) => document.getElementById(id);

/** A number with the given significant digits. */
function short(value, digits = 4) {
  if (value === null || value === undefined || Number.isNaN(value)) return "–";
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size >= 1e6 || size < 1e-3) return value.toExponential(Math.max(0, digits - 1)).replace("e+", "e");
  if (size >= 1000) return Math.round(value).toLocaleString("en");
  return String(Number(value.toPrecision(digits)));
}

const percent = (share) => (share > 0.9995 && share < 1 ? "more than 99.9 %" : `${short(100 * share, 3)} %`);

/** Where a setup comes from. */
function origin(setup, several) {
  const preference = setup.preference === null ? "" : `, preference ${short(setup.preference)}`;
  return `${several ? `${setup.run.name}: ` : ""}row ${setup.row}, ${setup.method}${preference}`;
}

const scores = (setup) => `R = ${short(setup.R)}, ${setup.run.symbol} = ${short(setup.P)}${setup.each.length ? ` (${eachOf(setup).join(", ")})` : ""}`;

/** The potential of each of several objectives, as text. */
const eachOf = (setup, of = short) => setup.each.map((value, j) => `${setup.run.objectives.names[j]} ${of(value)}`);

/** What R means: the ratio of the strongest to the weakest direction of the parameters. */
function regularityText(setup) {
  const lattice = setup.run.representation === "ffd", direct = setup.run.manipulation === "direct";
  if (!(setup.R > 0) && lattice) return `R = 0: some combination of the ${direct ? "points on the surface" : "control points"} does not change the design. ${direct ? "One of them may lie outside the box." : "A control point may have no vertex in reach, or the design is a quadric or a flat patch, on which a lattice of a higher degree depends on itself."} Choose another setup, a lower degree, or fewer of them.`;
  if (!(setup.R > 0)) return "R = 0: some combination of the parameters does not change the design, or (direct manipulation) the control points cannot be moved one by one. A center may have no vertex within reach, or two may coincide. Choose another setup.";
  const parameters = lattice && direct ? "displacements of points on the surface" : lattice || direct ? "displacements of the control points" : "RBF weights";
  return `The same step in the parameters (${parameters}) changes the design up to ${short(1 / setup.R, 3)} times as much in one direction as in another. ` +
    "The nearer to 1, the fewer steps an evolution strategy or a gradient descent needs with one step size for all. If your optimizer works on an orthonormal basis of the same deformations, R does not matter.";
}

/** What P means: the share of the wanted displacement that is within reach. */
function potentialText(setup, mesh) {
  if (setup.each.length) {
    const gains = eachOf(setup, (value) => percent(Math.sqrt(Math.max(0, value)))).join(", ");
    const size = setup.run.bounded ? "with the same bound on the displacement" : "of the same size";
    return `Of the objectives' own potentials it is the ${setup.run.objectives.combination}. To first order, the best step within reach for each alone gains of what a step ${size} with all vertices free gains: ${gains}.`;
  }
  if (setup.run.bounded) return `To first order, the best step within reach gains ${percent(Math.sqrt(Math.max(0, setup.P)))} of what a step with all vertices free gains, both with the same bound on the displacement: for a large p, on its largest vector.`;
  const left = percent(Math.sqrt(Math.max(0, 1 - setup.P)));
  if (mesh.direction) return `To first order, the best step within reach improves the objective by ${percent(Math.sqrt(Math.max(0, setup.P)))} of the improvement by a step of the same size with all vertices free; ${left} of the sensitivity (root mean square) is out of reach of any optimizer.`;
  return `${percent(setup.P)} of the wanted displacement (its squares, summed over the design) is within reach of these control points; the residual is ${left} of it (root mean square), with any optimizer.`;
}

/** What V means: independent ways to deform the design. */
function variabilityText(setup) {
  if (Number.isNaN(setup.V)) return null;
  const rank = Math.round(setup.V * setup.run.n), sides = setup.run.mirror ? " (both sides of the symmetry plane together)" : "";
  if (setup.run.representation === "ffd" && setup.run.manipulation === "direct") return `${rank} independent ways to deform ${setup.run.n.toLocaleString("en")} vertices${sides}. Points on the surface reach less than all control points of the lattice do: V and P depend on the manipulation.`;
  return `${rank} independent ways to deform ${setup.run.n.toLocaleString("en")} vertices${sides}` + (rank < setup.run.m ? `: fewer than the ${setup.run.m} control points, so some of them have no effect of their own.` : ": with more of them, the later optimization needs more evaluations.");
}

/** The card of one setup. */
function card(setup, mesh, title, several) {
  const list = el("dl", {},
    el("dt", {}, `R = ${short(setup.R)}`), el("dd", {}, el("b", {}, "Regularity. "), regularityText(setup)),
    el("dt", {}, `${setup.run.symbol} = ${short(setup.P)}`), el("dd", {}, el("b", {}, `${setup.run.potential_name[0].toUpperCase()}${setup.run.potential_name.slice(1)}. `), potentialText(setup, mesh)));
  const variability = variabilityText(setup);
  if (variability) list.append(el("dt", {}, `V = ${short(setup.V)}`), el("dd", {}, el("b", {}, "Variability. "), variability));
  return el("div", { class: "card" }, el("h3", {}, title), el("p", { class: "hint" }, `${origin(setup, several)}${setup.nondominated ? "; no other setup of its run is better in both scores" : "; another setup of its run is at least as good in both scores"}`), list);
}

/** How two setups differ. */
function comparison(a, b) {
  const times = b.R > 0 && a.R > 0 ? `${short(a.R / b.R, 3)} times the regularity` : "another regularity";
  const residual = 1 - b.P > 0 ? `${short((1 - a.P) / (1 - b.P), 3)} times its squared residual` : "another residual";
  const name = a.run.objectives ? a.run.potential_name : "bounded potential";
  if (a.run.bounded || a.run.objectives) return `Compared with the kept setup, the chosen one has ${times} and ${b.P > 0 ? `${short(a.P / b.P, 3)} times its` : "another"} ${name}.`;
  return `Compared with the kept setup, the chosen one has ${times} and ${residual}.`;
}

/** The commands that continue with a setup. */
function nextSteps(setup, mesh) {
  const place = setup.run.place || ".";
  const pick = `python -m rbfevo.export ${place} --pick index:${setup.row}`;
  const fit = mesh.direction || setup.run.mirror ? "" : `\npython -m rbfevo.fit ${place} --pick index:${setup.row}`;
  return el("div", {}, el("p", {}, "To continue with the chosen setup, in the directory of this page:"),
    el("pre", {}, `${pick}${fit}\npython -m rbfevo.show ${place} --pick index:${setup.row}`),
    el("p", {}, "The first command writes its control points for spreadsheets, ParaView, NumPy and PyGeM" + (fit ? ", the second carries out a trial optimization" : "") + ", the last shows it in a window." +
      (setup.each.length ? " Its step follows the weighted sum of the sensitivities, or one of them with --objective NAME; with --keep NAME an objective gets no worse." : "")));
}

/** How one run was made. */
function madeDetails(run) {
  const { command, facts, versions, notes, warnings } = run.made, body = el("div", {});
  body.append(el("h3", {}, run.title));
  if (command) {
    const copy = el("button", { type: "button", on: { click: () => copyText(command, copy) } }, "Copy");
    body.append(el("pre", {}, command), el("p", {}, copy));
  }
  const table = el("table", {});
  for (const [name, value] of Object.entries(facts)) table.append(el("tr", {}, el("th", { class: "text", scope: "row" }, name), el("td", { class: "text" }, typeof value === "number" ? short(value, 6) : String(value))));
  if (Object.keys(versions).length) table.append(el("tr", {}, el("th", { class: "text", scope: "row" }, "versions"), el("td", { class: "text", style: "white-space: normal" }, Object.entries(versions).map(([name, version]) => `${name} ${version}`).join(", "))));
  body.append(el("div", { class: "scroll" }, table));
  const lines = [...Object.values(notes), ...warnings.map((warning) => `Warning: ${warning}`)];
  if (lines.length) body.append(el("ul", {}, ...lines.map((line) => el("li", {}, String(line)))));
  return body;
}

/** Put text on the clipboard, and say so on the button. */
async function copyText(text, button) {
  const before = (button.dataset.label ||= button.textContent);
  try {
    await navigator.clipboard.writeText(text);
  } catch { // a page from a file may not be allowed to
    const area = el("textarea", {}, text);
    document.body.append(area);
    area.select();
    document.execCommand("copy");
    area.remove();
  }
  button.textContent = "Copied";
  setTimeout(() => { button.textContent = before; }, 1500);
}

function bibtex(version) {
  return `@inproceedings{Richter2017,
  author = {Richter, Andreas and Achenbach, Jascha and Menzel, Stefan and Botsch, Mario},
  title = {Multi-objective Representation Setups for Deformation-based Design Optimization},
  booktitle = {Evolutionary Multi-Criterion Optimization (EMO)},
  year = {2017}
}
@software{rbfevo,
  title = {rbfevo},
  version = {${version || "?"}}
}`;
}

/** Let the browser save a file. */
function save(blob, name) {
  const link = el("a", { href: URL.createObjectURL(blob), download: name });
  document.body.append(link);
  link.click();
  link.remove();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}
