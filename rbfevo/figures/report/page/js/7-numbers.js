// A sweep over the number of centers: potential and the knee's regularity over it, and nested sequences beside them.

const SEQUENCE_DASHES = ["dot", "dash", "dashdot"];

/** What there is on the mesh that is shown; null where no settings were tried with several numbers of centers. */
function numbersShown(state) {
  const numbers = state.content.sweep?.numbers;
  if (!numbers) return null;
  const own = (list) => list.filter((entry) => entry.mesh === state.meshIndex), curves = own(numbers.curves);
  return curves.length ? { curves, sequences: own(numbers.sequences), sentences: numbers.sentences[state.meshIndex], logarithmic: numbers.logarithmic[state.meshIndex] } : null;
}

function drawNumbers(state) {
  const shown = numbersShown(state);
  byId("numbers").hidden = !shown;
  if (!shown) return;
  const run = runShown(state), potential = `${run.potential_name}${run.bounded ? "" : " P"}`;
  byId("numbers-sentences").replaceChildren(...shown.sentences.map(answer));
  byId("numbers-hint").textContent = `Solid: best ${run.symbol}. Dashed: ${run.symbol} of the knee. Upright: the fewest centers tried with ${state.content.sweep.numbers.share} of the largest gain, the square root of ${run.symbol}.` +
    (shown.sequences.length ? " Grey: the first centers that OLS places one after the other, none moved later." : "") + (shown.curves.some(({ seeds }) => Math.max(...seeds) > 1) ? " Medians over the seeds; bars are quartiles." : "");
  drawOver(state, "numbers-potential", shown, potential, false, [["best", "solid"], ["knee_potential", "dash"]], (sequence) => sequence.potential);
  drawOver(state, "numbers-regularity", shown, `R of the knee${shown.logarithmic ? " (logarithmic)" : ""}`, shown.logarithmic, [["knee_regularity", "solid"]], (sequence) => sequence.regularity);
  drawNumbersTable(state, shown);
}

/** Numbers of centers beside the axis: round ones, or where they lie close together those that were tried. */
function numberTicks({ curves, sequences }) {
  const tried = [...new Set(curves.flatMap((curve) => curve.centers))];
  const wide = sequences.length || Math.max(...tried) >= 4 * Math.min(...tried);
  return wide ? [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000] : tried;
}

/** One plot over the number of centers: for each curve the quantities `keys` with their dashes, and the sequences. */
function drawOver(state, id, shown, title, logarithmic, keys, ofSequence) {
  const colors = theme(), palette = colors.dark ? QUALITATIVE_ON_DARK : QUALITATIVE, narrow = byId(id).clientWidth < 520;
  const place = (value) => (value === null || (logarithmic && !(value > 0)) ? null : value);
  const traces = shown.sequences.map((sequence, i) => ({
    type: "scatter", mode: "lines", name: sequence.label, legendgroup: `sequence ${i}`, x: sequence.potential.map((_, m) => m + 1), y: ofSequence(sequence).map(place),
    hovertemplate: `%{x} centers: %{y:.5g}<extra>${sequence.label}</extra>`, line: { color: colors.grey, width: 1.5, dash: SEQUENCE_DASHES[i % SEQUENCE_DASHES.length] },
  }));
  shown.curves.forEach((curve, i) => {
    const color = palette[i % palette.length];
    for (const [key, dash] of keys) {
      const spreads = curve[key], several = Math.max(...curve.seeds) > 1;
      const bar = (end) => spreads.map((spread) => (spread.median === null ? 0 : Math.abs(spread[end] - spread.median)));
      traces.push({
        type: "scatter", mode: "lines+markers", name: curve.label, legendgroup: curve.label, showlegend: key === keys[0][0], x: curve.centers, y: spreads.map((spread) => place(spread.median)),
        hovertemplate: `%{x} centers: %{y:.5g}<extra>${curve.label}${key === "knee_potential" ? ", knee" : ""}</extra>`, line: { color, width: 2, dash: dash === "dash" ? "dash" : "solid" },
        marker: { color, size: 8, symbol: dash === "dash" ? "circle-open" : "circle" }, connectgaps: false, ...(several ? { error_y: { type: "data", symmetric: false, array: bar("third"), arrayminus: bar("first"), color, thickness: 1.5, width: 3 } } : {}),
      });
    }
  });
  const uprights = shown.curves.map((curve, i) => ({ curve, color: palette[i % palette.length] })).filter(({ curve }) => curve.enough !== null);
  const layout = {
    height: 340 + 18 * (shown.curves.length + shown.sequences.length), margin: { l: 56, r: 12, t: 12, b: 44 }, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", font: { color: colors.ink, size: 12 }, hovermode: "closest", dragmode: touched() ? false : "zoom",
    hoverlabel: { bgcolor: colors.paper, bordercolor: colors.grey, font: { color: colors.ink } }, legend: { orientation: "v", yref: "container", y: 0, yanchor: "bottom", x: 0, font: { size: narrow ? 10 : 12 } },
    xaxis: { ...axisLook(colors), title: { text: "number of centers (logarithmic)" }, type: "log", tickmode: "array", tickvals: numberTicks(shown), zeroline: false },
    yaxis: { ...axisLook(colors), title: { text: title }, type: logarithmic ? "log" : "linear", zeroline: false, ...(logarithmic ? { exponentformat: "power", dtick: 1 } : {}) },
    shapes: uprights.map(({ curve, color }) => ({ type: "line", xref: "x", yref: "paper", x0: curve.enough, x1: curve.enough, y0: 0, y1: 1, line: { color, width: 1 }, opacity: 0.7, layer: "below" })),
  };
  Plotly.react(byId(id), traces, layout, ZOOMING());
}

function drawNumbersTable(state, shown) {
  const { symbol } = runShown(state), titles = ["settings", "centers", "seeds", `best ${symbol}`, `${symbol} of the knee`, "R of the knee"];
  const cell = ({ median, first, third }, seeds) => (median === null ? "–" : seeds > 1 ? `${short(median)} [${short(first)}, ${short(third)}]` : short(median));
  const rows = shown.curves.flatMap((curve) => curve.centers.map((number, i) => el("tr", { class: number === curve.enough ? "chosen" : null },
    el("td", { class: "text" }, curve.label), el("td", {}, String(number)), el("td", {}, String(curve.seeds[i])), ...["best", "knee_potential", "knee_regularity"].map((key) => el("td", {}, cell(curve[key][i], curve.seeds[i]))))));
  byId("numbers-table").replaceChildren(el("thead", {}, el("tr", {}, ...titles.map((title, i) => el("th", { scope: "col", class: i ? null : "text" }, title)))), el("tbody", {}, ...rows));
}
