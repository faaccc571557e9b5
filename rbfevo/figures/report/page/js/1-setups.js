// The setups of all runs as one list, and the picks among them.

/** Numbers from base64 of their bytes; `Kind` is a typed array. */
function unpacked(text, Kind) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return new Kind(bytes.buffer);
}

/** Every setup: its run, its place in that run's arrays, its row in setups.npz, scores, and where it belongs. */
function setupsOf(content) {
  const setups = [];
  content.runs.forEach((run, runIndex) => {
    run.index = runIndex;
    for (const name of ["regularity", "potential", "variability", "centers"]) run[name] = unpacked(run[name], Float64Array);
    const several = run.objectives, each = several ? unpacked(several.potentials, Float64Array) : null;
    run.rows.forEach((row, place) => {
      setups.push({
        index: setups.length,
        run,
        place,
        row,
        R: run.regularity[place],
        P: run.potential[place],
        each: several ? Array.from(each.subarray(place * several.names.length, (place + 1) * several.names.length)) : [],
        V: run.variability[place],
        method: run.method[place],
        preference: run.preference[place],
        series: run.series[place],
        nondominated: run.nondominated[place] === 1,
      });
    });
  });
  return setups;
}

/** A run on the mesh that is shown: all of them searched the same potential. */
const runShown = (state) => state.content.runs.find((run) => run.mesh === state.meshIndex);

/** The centers [m][d] of a setup. */
function centersOf(setup, d) {
  const { m, centers } = setup.run;
  return Array.from({ length: m }, (_, j) => Array.from(centers.subarray((setup.place * m + j) * d, (setup.place * m + j + 1) * d)));
}

/** Those of `setups` that no other one dominates; equal ones all stay. */
function nondominated(setups) {
  const order = [...setups].sort((a, b) => b.R - a.R || b.P - a.P);
  const found = new Set();
  let best = -Infinity, at = NaN;
  for (const setup of order) {
    if (setup.P > best) { best = setup.P; at = setup.R; found.add(setup); }
    else if (setup.P === best && setup.R === at) found.add(setup);
  }
  return setups.filter((setup) => found.has(setup));
}

/** The front by rising regularity, the better one first where it ties. */
function frontOf(setups, single) {
  const members = single ? setups.filter((setup) => setup.nondominated) : nondominated(setups);
  return members.sort((a, b) => a.R - b.R || b.P - a.P || a.index - b.index);
}

/** The front's spread in both scores; 1 where there is none. */
function spreadOf(front) {
  const ends = (values) => { const low = Math.min(...values), high = Math.max(...values); return [low, high > low ? high - low : 1]; };
  return { R: ends(front.map((setup) => setup.R)), P: ends(front.map((setup) => setup.P)) };
}

/** The member of the front farthest from the chord between its ends, both axes scaled to [0, 1]; the lowest of equals. */
function kneeOf(front) {
  if (!front.length) return null;
  const { R, P } = spreadOf(front);
  const far = (setup) => Math.abs((setup.R - R[0]) / R[1] + (setup.P - P[0]) / P[1] - 1);
  const most = Math.max(...front.map(far));
  return front.filter((setup) => far(setup) >= most - 1e-12).sort((a, b) => a.index - b.index)[0];
}

/** The setup that is largest in one score, of those the largest in the other. */
function bestOf(setups, first, second) {
  return setups.reduce((best, setup) => (!best || setup[first] > best[first] || (setup[first] === best[first] && setup[second] > best[second]) ? setup : best), null);
}

/** The preferences, from and to, for which `setup` is as good as any; null if there are none. */
function preferencesOf(setup, setups) {
  let from = 0, to = 1;
  for (const other of setups) {
    const slope = setup.R - other.R - (setup.P - other.P), least = setup.P - other.P; // slope * preference + least >= 0
    if (slope > 0) from = Math.max(from, -least / slope);
    else if (slope < 0) to = Math.min(to, -least / slope);
    else if (least < 0) return null;
  }
  return from <= to + 1e-12 ? [from, to] : null;
}

/** The setup that maximizes preference R + (1 - preference) P, the lowest of equals (paper, eq. 9). */
function preferred(setups, preference) {
  let best = null, most = -Infinity;
  for (const setup of setups) {
    const value = preference * setup.R + (1 - preference) * setup.P;
    if (value > most) { most = value; best = setup; }
  }
  return best;
}

/** The setup at a place along the front: 0 is its end of improvement potential, 1 that of regularity. */
const alongFront = (front, place) => front[Math.round(place * (front.length - 1))];
