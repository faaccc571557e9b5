// The 3-D views: the template, coloured, and the centers as balls.

const LIGHT = { x: -3e4, y: 4e4, z: -1e5 }; // beside the eye, which looks along z

/** A ball as unit vertices and triangles, rings from pole to pole. */
const BALL = (() => {
  const rings = 7, around = 12, points = [], triangles = [];
  for (let i = 0; i <= rings; i++) for (let j = 0; j < around; j++) {
    const polar = (Math.PI * i) / rings, turn = (2 * Math.PI * j) / around;
    points.push([Math.sin(polar) * Math.cos(turn), Math.sin(polar) * Math.sin(turn), Math.cos(polar)]);
  }
  for (let i = 0; i < rings; i++) for (let j = 0; j < around; j++) {
    const a = i * around + j, b = i * around + ((j + 1) % around);
    triangles.push([a, a + around, b], [b, a + around, b + around]);
  }
  return { points, triangles };
})();

/** Balls at places [q][3] as one mesh. */
function balls(places, radius, color, names) {
  const x = [], y = [], z = [], i = [], j = [], k = [], text = [];
  places.forEach((place, which) => {
    const first = x.length;
    for (const point of BALL.points) { x.push(place[0] + radius * point[0]); y.push(place[1] + radius * point[1]); z.push(place[2] + radius * point[2]); text.push(names[which]); }
    for (const [a, b, c] of BALL.triangles) { i.push(first + a); j.push(first + b); k.push(first + c); }
  });
  return { type: "mesh3d", x, y, z, i, j, k, text, hoverinfo: "text", color, lighting: { ambient: 0.5, diffuse: 0.6, specular: 0.25, roughness: 0.5, fresnel: 0 }, lightposition: LIGHT };
}

/** A point with three coordinates. */
const spatial = (point) => [point[0], point[1], point.length > 2 ? point[2] : 0];

/** A point about the middle of the mesh. */
const about = (point, mesh) => spatial(point).map((value, axis) => value - mesh.middle[axis]);

/** All centers that the deformation really has: those of the setup and their mirror images. */
function placesOf(setup, mesh) {
  const own = centersOf(setup, mesh.d), mirror = setup.run.mirror;
  const images = mirror ? own.map((center, j) => [center, j]).filter(([center]) => center[mirror.axis] !== mirror.at).map(([center, j]) => [imageOf(center, mirror), j]) : [];
  return { own, images };
}

/** Coordinates [n] of the vertices about the mesh's middle, since the views have single precision; moved by rows [n * k] times a factor; heights go up. */
function moved(mesh, rows, factor) {
  const { n, d, k } = mesh, xyz = [0, 1, 2].map(() => new Float32Array(n));
  for (let i = 0; i < n; i++) for (let axis = 0; axis < 3; axis++) {
    let value = axis < d ? mesh.vertices[i * d + axis] - mesh.middle[axis] : 0;
    const component = k === 1 ? (axis === 2 ? 0 : -1) : axis < k ? axis : -1;
    if (rows && component >= 0) value += factor * rows[i * k + component];
    xyz[axis][i] = value;
  }
  return xyz;
}

/** The box that every view of a mesh shows: template, wanted shape and all centers. */
function boxOf(mesh, setups) {
  if (mesh.box) return mesh.box;
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  const take = (axis, value) => { if (value < low[axis]) low[axis] = value; if (value > high[axis]) high[axis] = value; };
  for (const shape of [moved(mesh, null, 0), ...mesh.fields.map(({ gradient, stretch }) => moved(mesh, gradient, stretch))]) shape.forEach((values, axis) => values.forEach((value) => take(axis, value)));
  for (const setup of setups) {
    const { own, images } = placesOf(setup, mesh);
    for (const place of [...own, ...images.map(([image]) => image)]) about(place, mesh).forEach((value, axis) => take(axis, value));
  }
  const radius = radiusOf(mesh, setups[0]);
  mesh.box = low.map((value, axis) => [value - 1.5 * radius, high[axis] + 1.5 * radius]);
  return mesh.box;
}

function radiusOf(mesh, setup) {
  return 0.0125 * Math.hypot(...mesh.extent) * Math.min(1, Math.sqrt(25 / (setup ? setup.run.m : 25)));
}

/** What the colours of a view stand for at every vertex [n]; null where it is not known. */
function valuesOf(state, setup, mesh) {
  if (state.color === "wanted") return mesh.wanted;
  const found = leftOf(setup, mesh);
  return found && found.norms;
}

/** The value at which the colours end: the largest wanted displacement, or nearly the largest residual of three setups. */
function highest(state) {
  const mesh = state.mesh;
  if (state.color === "wanted") return mesh.most || 1;
  const samples = [state.knee, bestOf(state.visible, "R", "P"), bestOf(state.visible, "P", "R")].filter((setup) => setup && hasResidual(setup));
  const key = `${state.filterKey} ${samples.map((setup) => setup.index)}`;
  if (mesh.highestKey !== key) {
    mesh.highestKey = key;
    mesh.highest = Math.max(0, ...samples.map((setup) => { const norms = leftOf(setup, mesh).norms.slice().sort(); return norms[Math.floor(0.995 * (norms.length - 1))]; })) || mesh.most || 1;
  }
  return mesh.highest;
}

/** The vertices of the shape that is shown. */
function shapeOf(state, setup, mesh) {
  if (state.shape === "template") return (mesh.template ||= moved(mesh, null, 0));
  if (state.shape === "wanted") return (mesh.target ||= moved(mesh, mesh.gradient, mesh.stretch));
  const found = leftOf(setup, mesh);
  return moved(mesh, found ? mesh.gradient.map((value, i) => value - found.left[i]) : null, mesh.stretch);
}

/** The corners of the faces, as the plotting library wants them. */
function cornersOf(mesh) {
  if (!mesh.corners) mesh.corners = [0, 1, 2].map((corner) => Uint32Array.from({ length: mesh.faces.length / 3 }, (_, f) => mesh.faces[3 * f + corner]));
  return mesh.corners;
}

/** Draw a setup into the view `which`, a or b. */
function drawView(state, which, setup) {
  const mesh = state.mesh, colors = theme(), plot = byId(`space-${which}`);
  const values = valuesOf(state, setup, mesh), [x, y, z] = shapeOf(state, setup, mesh), [i, j, k] = cornersOf(mesh);
  const look = { colorscale: state.content.colors, cmin: 0, cmax: highest(state) };
  const surface = mesh.faces.length
    ? { type: "mesh3d", x, y, z, i, j, k, hoverinfo: "skip", opacity: state.seeThrough ? 0.45 : 1, lighting: { ambient: 0.68, diffuse: 0.4, specular: 0.03, roughness: 0.9, fresnel: 0 }, lightposition: LIGHT, ...(values ? { intensity: values, ...look, showscale: false } : { color: colors.clay }) }
    : { type: "scatter3d", mode: "markers", x, y, z, hoverinfo: "skip", marker: { size: 2, opacity: state.seeThrough ? 0.35 : 1, ...(values ? { color: values, ...look } : { color: colors.clay }) } };
  const { own, images } = placesOf(setup, mesh), radius = radiusOf(mesh, setup);
  const name = (place, j, image) => `center ${j}${image ? ", mirrored" : ""}<br>${place.map((value) => short(value)).join(", ")}`;
  const traces = [surface, balls(own.map((place) => about(place, mesh)), radius, colors.center, own.map((place, j) => name(place, j, false)))];
  if (images.length) traces.push(balls(images.map(([place]) => about(place, mesh)), radius, colors.image, images.map(([place, j]) => name(place, j, true))));
  const box = boxOf(mesh, state.setups.filter((other) => other.run.mesh === setup.run.mesh)), flat = mesh.d === 2;
  const axis = (index) => ({ range: box[index], visible: flat && index < 2, showbackground: false, showspikes: false, gridcolor: colors.line, color: colors.grey, title: { text: flat ? "xyz"[index] : "" }, zeroline: false, ...(flat && index < 2 ? ticksOf(box[index], mesh.middle[index]) : {}) });
  const layout = {
    margin: { l: 0, r: 0, t: 0, b: 0 }, paper_bgcolor: colors.panel, showlegend: false, hoverlabel: { bgcolor: colors.paper, bordercolor: colors.grey, font: { color: colors.ink } },
    scene: { aspectmode: "manual", aspectratio: state.sides || startSides(mesh, plot), xaxis: axis(0), yaxis: axis(1), zaxis: axis(2), dragmode: "orbit", camera: state.camera || startCamera(mesh) },
  };
  Plotly.react(plot, traces, layout, { ...CONFIG, scrollZoom: !touched() });
  if (!plot.dataset.listens) {
    plot.dataset.listens = "yes";
    plot.on("plotly_relayout", (change) => followCamera(state, which, change));
    plot.on("plotly_relayouting", (change) => followCamera(state, which, change));
  }
}

/** The camera at first: where most of what is wanted shows. */
function startCamera(mesh) {
  const [x, y, z] = mesh.towards;
  return { eye: { x: 2 * x, y: 2 * y, z: 2 * z }, up: { x: mesh.up[0], y: mesh.up[1], z: mesh.up[2] }, center: { x: 0, y: 0, z: 0 }, projection: { type: "orthographic" } };
}

/** The sides of the scene, with which all of it just fits at first: an orthographic view shows -1 to 1 upwards. */
function startSides(mesh, plot) {
  const right = unit(cross(mesh.up, mesh.towards)), up = cross(mesh.towards, right), sides = mesh.box.map(([low, high]) => high - low);
  const half = (axis) => sides.reduce((sum, side, which) => sum + Math.abs(axis[which] * side) / 2, 0);
  const zoom = 0.98 / Math.max(half(up), half(right) / Math.max(0.3, plot.clientWidth / Math.max(1, plot.clientHeight)));
  return { x: zoom * sides[0], y: zoom * sides[1], z: zoom * sides[2] };
}

const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((part) => part / Math.hypot(...a));

/** The other view turns and zooms along. */
function followCamera(state, which, change) {
  const moves = Object.fromEntries(["scene.camera", "scene.aspectratio"].filter((key) => change[key]).map((key) => [key, change[key]]));
  if (!Object.keys(moves).length || state.following) return;
  state.camera = moves["scene.camera"] || state.camera;
  state.sides = moves["scene.aspectratio"] || state.sides;
  if (!state.kept) return;
  state.following = true;
  Promise.resolve(Plotly.relayout(byId(which === "a" ? "space-b" : "space-a"), moves)).finally(() => { state.following = false; });
}

/** Turn the views back to where they began. */
function turnBack(state) {
  for (const which of state.kept ? ["a", "b"] : ["a"]) {
    const plot = byId(`space-${which}`);
    Plotly.relayout(plot, { "scene.camera": startCamera(state.mesh), "scene.aspectratio": startSides(state.mesh, plot) });
  }
  state.camera = state.sides = null;
}

/** Some ticks of an axis that is drawn about `middle`, with their true values. */
function ticksOf([low, high], middle) {
  const step = 10 ** Math.floor(Math.log10((high - low) / 2)), first = Math.ceil((low + middle) / step);
  const values = Array.from({ length: Math.floor((high + middle) / step) - first + 1 }, (_, which) => (first + which) * step);
  const kept = values.filter((_, which) => which % Math.ceil(values.length / 4) === 0);
  return { tickmode: "array", tickvals: kept.map((value) => value - middle), ticktext: kept.map((value) => short(value)) };
}

/** The scale of the colours, and notes on the view. */
function drawScale(state) {
  const mesh = state.mesh, factor = mesh.scale || 1;
  byId("scale-low").textContent = "0";
  byId("scale-high").textContent = `${state.color === "left" ? "≥ " : ""}${short(factor * highest(state), 3)}`;
  byId("scale-unit").textContent = mesh.scale ? "model units" : mesh.direction ? `of the sensitivity${mesh.name && ` of ${mesh.name}`} (unit norm)` : "of the displacement (unit norm)";
  byId("scale-bar").style.background = `linear-gradient(to right, ${state.content.colors.map(([at, color]) => `${color} ${100 * at}%`).join(", ")})`;
  const notes = state.flaw ? [state.flaw] : [];
  if (mesh.n < mesh.of) notes.push(`This page shows and computes with ${mesh.n.toLocaleString("en")} of ${mesh.of.toLocaleString("en")} vertices; R and ${runShown(state).symbol} are those of all.`);
  if (runShown(state).bounded && (state.color === "left" || state.shape === "reached")) notes.push("What is reached, and the residual, are those of the least-squares fit (of P), not of the step that the bounded potential is about.");
  if (state.shape !== "template") notes.push("Centers are shown at their first places.");
  if (state.shape !== "template" && mesh.remark) notes.push(`Shape: ${mesh.remark}.`);
  if (state.color === "left" && state.chosen && !hasResidual(state.chosen)) notes.push("This page does not hold the residual of this setup.");
  if (state.seeThrough === false && mesh.d === 3) notes.push("To see centers inside or behind the surface, see through it or turn it.");
  byId("view-hint").textContent = notes.join(" ");
}

/** The centers of a setup as rbfevo.export writes them. */
function centersCsv(setup, mesh) {
  const { own, images } = placesOf(setup, mesh), mirror = setup.run.mirror;
  const line = (place, j, mirrored) => [j, ...spatial(place), mirrored, mirror && place[mirror.axis] === mirror.at ? 2 : 1].join(",");
  return ["center,x,y,z,mirrored,times", ...own.map((place, j) => line(place, j, 0)), ...images.map(([place, j]) => line(place, j, 1)), ""].join("\n");
}

/** Front and views as one picture. */
async function pictureOf(state) {
  const colors = theme(), side = 640, gap = 24, head = 76, foot = 36;
  const divs = ["front", "space-a", ...(state.kept ? ["space-b"] : [])];
  const made = await Promise.all(divs.map((id) => Plotly.toImage(byId(id), { format: "png", width: side, height: side, scale: 2 })));
  const images = await Promise.all(made.map((source) => new Promise((done, fail) => { const image = new Image(); image.onload = () => done(image); image.onerror = fail; image.src = source; })));
  const canvas = el("canvas", { width: 2 * (divs.length * (side + gap) + gap), height: 2 * (head + side + foot) }), pen = canvas.getContext("2d");
  pen.scale(2, 2);
  pen.fillStyle = colors.panel;
  pen.fillRect(0, 0, canvas.width, canvas.height);
  pen.fillStyle = colors.ink;
  pen.font = "600 18px system-ui, sans-serif";
  pen.fillText(state.chosen.run.title, gap, 30, canvas.width / 2 - 2 * gap);
  pen.font = "15px system-ui, sans-serif";
  const captions = ["", byId("caption-a").textContent, byId("caption-b").textContent];
  const ring = (x, y, color) => { pen.beginPath(); pen.arc(x, y, 6, 0, 2 * Math.PI); pen.lineWidth = 3; pen.strokeStyle = color; pen.stroke(); };
  images.forEach((image, which) => {
    const left = gap + which * (side + gap);
    if (captions[which]) ring(left + 8, 53, which === 1 ? colors.center : colors.accent);
    pen.fillStyle = colors.ink;
    pen.fillText(captions[which], left + (captions[which] ? 24 : 0), 58, side - 24);
    pen.drawImage(image, left, head, side, side);
  });
  pen.fillStyle = colors.grey;
  const what = state.color === "wanted" ? "wanted displacement" : "residual, what the setup cannot reach";
  const start = 2 * gap + side, fade = pen.createLinearGradient(start + 12, 0, start + 172, 0), low = head + side + 22;
  for (const [at, color] of state.content.colors) fade.addColorStop(at, color);
  pen.fillText("0", start, low);
  pen.fillText(`${byId("scale-high").textContent} ${byId("scale-unit").textContent}: ${what}`, start + 180, low, side - 180);
  pen.fillStyle = fade;
  pen.fillRect(start + 12, low - 12, 160, 13);
  return new Promise((done) => { canvas.toBlob(done, "image/png"); });
}
