// What a setup reaches of the wanted displacement: U U^+ g, by the modified Gram-Schmidt process on [U | g].

/** The kernel at a squared distance. */
function kernelOf(run) {
  if (run.formula === "wendland") {
    const s = run.support;
    return (r2) => {
      const q = Math.sqrt(r2) / s;
      return q < 1 ? (1 - q) ** 4 * (4 * q + 1) : 0;
    };
  }
  return run.formula === "thin_plate" ? (r2) => (r2 > 0 ? 0.5 * r2 * Math.log(r2) : 0) : (r2) => r2 * Math.sqrt(r2);
}

/** The image of a center [d] in a run's symmetry plane. */
function imageOf(center, mirror) {
  const image = [...center];
  image[mirror.axis] = 2 * mirror.at - center[mirror.axis];
  return image;
}

/** Column of Phi [n] of one center; with a mirror that along its plane, or across it (null where there is none). */
function columnOf(center, mesh, run, factors, across) {
  const { vertices, n, d } = mesh, phi = kernelOf(run), mirror = run.mirror;
  if (across && center[mirror.axis] === mirror.at) return null;
  const column = new Float64Array(n);
  const add = (point, sign) => {
    for (let i = 0, at = 0; i < n; i++, at += d) {
      let r2 = 0;
      for (let axis = 0; axis < d; axis++) { const step = vertices[at + axis] - point[axis]; r2 += step * step; }
      column[i] += sign * phi(r2);
    }
  };
  add(center, 1);
  if (mirror) add(imageOf(center, mirror), across ? -1 : 1);
  if (factors) for (let i = 0; i < n; i++) column[i] *= factors[i];
  return column;
}

const dot = (a, b) => { let sum = 0; for (let i = 0; i < a.length; i++) sum += a[i] * b[i]; return sum; };

/** Subtract from each residual its projection on the `columns`; columns that depend on others count once. */
function project(columns, residuals) {
  const norms = columns.map((column) => Math.sqrt(dot(column, column)));
  const cut = Math.max(columns.length ? columns[0].length : 0, columns.length) * Number.EPSILON * Math.max(0, ...norms);
  columns.forEach((column, j) => {
    const norm = Math.sqrt(dot(column, column));
    if (!(norm > cut)) return;
    for (let i = 0; i < column.length; i++) column[i] /= norm;
    for (const other of [...columns.slice(j + 1), ...residuals]) {
      const share = dot(column, other);
      for (let i = 0; i < column.length; i++) other[i] -= share * column[i];
    }
  });
}

/** The residual of a setup: its rows [n * k], their norms [n], and P on the vertices shown. */
function leftBy(setup, mesh) {
  const { n, k, d } = mesh, run = setup.run, centers = centersOf(setup, d), left = new Float64Array(n * k);
  const groups = [[[...Array(k).keys()], false]];
  if (run.mirror && k > 1) groups.splice(0, 1, [[...Array(k).keys()].filter((c) => c !== run.mirror.axis), false], [[run.mirror.axis], true]);
  let remaining = 0, whole = 0;
  for (const [components, across] of groups) {
    const columns = centers.map((center) => columnOf(center, mesh, run, mesh.factors, across)).filter((column) => column);
    const residuals = components.map((c) => Float64Array.from({ length: n }, (_, i) => mesh.gradient[i * k + c] * (mesh.roots ? mesh.roots[i] : 1)));
    whole += residuals.reduce((sum, component) => sum + dot(component, component), 0);
    project(columns, residuals);
    remaining += residuals.reduce((sum, component) => sum + dot(component, component), 0);
    components.forEach((c, which) => {
      for (let i = 0; i < n; i++) left[i * k + c] = mesh.roots ? residuals[which][i] / (mesh.roots[i] || 1) : residuals[which][i];
    });
  }
  return { left, norms: rowNorms(left, n, k), potential: whole > 0 ? 1 - remaining / whole : 0 };
}

/** Norms [n] of rows [n * k]. */
function rowNorms(rows, n, k) {
  const norms = new Float64Array(n);
  for (let i = 0; i < n; i++) {
    let sum = 0;
    for (let c = 0; c < k; c++) sum += rows[i * k + c] ** 2;
    norms[i] = Math.sqrt(sum);
  }
  return norms;
}

/** The arrays of a mesh from their base64, and what is wanted at each vertex. */
function unpackMesh(mesh) {
  mesh.vertices = unpacked(mesh.vertices, Float64Array);
  mesh.faces = unpacked(mesh.faces, Uint32Array);
  mesh.roots = mesh.weights ? unpacked(mesh.weights, Float64Array).map(Math.sqrt) : null;
  const blend = mesh.blend ? unpacked(mesh.blend, Float64Array) : null;  // 0 where a vertex is held
  mesh.factors = blend && mesh.roots ? blend.map((value, i) => value * mesh.roots[i]) : blend || mesh.roots;
  mesh.middle = [0, 1, 2].map((axis) => {
    let low = Infinity, high = -Infinity;
    for (let at = axis; axis < mesh.d && at < mesh.vertices.length; at += mesh.d) { low = Math.min(low, mesh.vertices[at]); high = Math.max(high, mesh.vertices[at]); }
    return axis < mesh.d ? (low + high) / 2 : 0;
  });
  mesh.fields = (mesh.objectives || [mesh]).map(({ name, gradient, stretch, remark }) => fieldOf(name, unpacked(gradient, Float64Array), mesh, stretch, remark));
  showObjective(mesh, 0);
  return mesh;
}

/** What of a mesh belongs to one objective: its wanted displacement, and what is computed from it. */
function fieldOf(name, gradient, mesh, stretch, remark) {
  const wanted = rowNorms(gradient, mesh.n, mesh.k);
  return { name: name || "", gradient, stretch, remark, wanted, most: wanted.reduce((a, b) => Math.max(a, b), 0), known: new Map(), target: null, highest: null, highestKey: null };
}

/** Let a mesh show another one of its objectives. */
function showObjective(mesh, index) {
  mesh.objective = index;
  Object.assign(mesh, mesh.fields[index]);
}

/** The residual of a setup from the numbers in the page; null if the page does not hold them. */
function embedded(setup, mesh) {
  const { n, k } = mesh, given = setup.run.embedded;
  if (!given) return null;
  if (!given.arrays) given.arrays = [given.left].flat().map((left) => unpacked(left, Float32Array)); // one for each objective
  const place = given.rows.indexOf(setup.place);
  if (place < 0) return null;
  const left = Float64Array.from(given.arrays[mesh.objective].subarray(place * n * k, (place + 1) * n * k));
  let remaining = 0, whole = 0;
  for (let i = 0; i < n * k; i++) {
    const weight = mesh.roots ? mesh.roots[Math.floor(i / k)] ** 2 : 1;
    remaining += weight * left[i] ** 2;
    whole += weight * mesh.gradient[i] ** 2;
  }
  return { left, norms: rowNorms(left, n, k), potential: whole > 0 ? 1 - remaining / whole : 0 };
}

/** Whether the page knows the residual of a setup. */
const hasResidual = (setup) => setup.run.known || (setup.run.embedded !== null && setup.run.embedded.rows.includes(setup.place));

/** `leftBy`, cached for the last setups. */
function leftOf(setup, mesh) {
  if (!hasResidual(setup)) return null;
  let found = mesh.known.get(setup.index);
  if (!found) found = setup.run.known ? leftBy(setup, mesh) : embedded(setup, mesh);
  mesh.known.delete(setup.index);
  mesh.known.set(setup.index, found);
  if (mesh.known.size > 24) mesh.known.delete(mesh.known.keys().next().value);
  return found;
}
