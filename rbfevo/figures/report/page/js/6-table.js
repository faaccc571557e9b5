// The table of all setups.

const COLUMNS = [
  { key: "row", title: "row", of: (setup) => setup.row },
  { key: "run", title: "run", text: true, sweep: true, of: (setup) => setup.run.name },
  { key: "method", title: "method", text: true, of: (setup) => setup.method },
  { key: "preference", title: "preference", of: (setup) => setup.preference },
  { key: "R", title: "R", of: (setup) => setup.R },
  { key: "P", title: "P", of: (setup) => setup.P },
  { key: "V", title: "V", of: (setup) => (Number.isNaN(setup.V) ? null : setup.V) },
  { key: "nondominated", title: "nondominated", of: (setup, state) => state.inFront.has(setup), show: (value) => (value ? "yes" : "no") },
];
const AT_ONCE = 300;

/** Two cells in order; empty ones last whichever way. */
function compare(a, b, down) {
  if (a === null || b === null) return (a === null) - (b === null);
  const order = typeof a === "string" ? a.localeCompare(b, "en", { numeric: true }) : a - b;
  return down ? -order : order;
}

/** A head whose buttons sort: columns of { key, title, text }, and what to do on a click. */
function sortingHead(columns, sort, act) {
  return el("thead", {}, el("tr", {}, ...columns.map((column) => {
    const now = sort.key === column.key;
    const arrow = now ? (sort.down ? " ↓" : " ↑") : "";
    return el("th", { scope: "col", class: column.text ? "text" : null, "aria-sort": now ? (sort.down ? "descending" : "ascending") : "none" },
      el("button", { type: "button", "data-key": column.key, on: { click: () => act(column.key) } }, column.title + arrow));
  })));
}

/** The sorting after a click on a column: numbers fall at first, text rises. */
function sortedBy(sort, column) {
  return sort.key === column.key ? { key: column.key, down: !sort.down } : { key: column.key, down: !column.text && column.key !== "row" };
}

function drawTable(state) {
  const { sort } = state, { symbol } = runShown(state);
  const { objectives } = runShown(state), own = (objectives?.names || []).map((name, j) => ({ key: `objective-${j}`, title: `${objectives.symbol} ${name}`, of: (setup) => setup.each[j] }));
  const columns = COLUMNS.filter((column) => !column.sweep || state.several).flatMap((found) => (found.key === "P" ? [{ ...found, title: symbol }, ...own] : [found]));
  const column = columns.find((found) => found.key === sort.key) || columns[0];
  const members = state.visible.filter((setup) => !byId("only-front").checked || state.inFront.has(setup));
  members.sort((a, b) => compare(column.of(a, state), column.of(b, state), sort.down) || a.index - b.index);
  const act = (key) => { state.sort = sortedBy(sort, columns.find((found) => found.key === key)); drawTable(state); byId("setups").querySelector(`[data-key="${key}"]`).focus(); };
  const body = el("tbody");
  for (const setup of members.slice(0, state.shownRows)) {
    const row = el("tr", { "data-index": setup.index });
    for (const { key, text, of, show } of columns) {
      const value = of(setup, state), content = show ? show(value) : typeof value === "number" && key !== "row" ? short(value) : value === null ? "" : String(value);
      row.append(el("td", { class: text ? "text" : null }, key === "row" ? el("button", { type: "button", "aria-label": `choose row ${content}${state.several ? ` of ${setup.run.name}` : ""}` }, content) : content));
    }
    body.append(row);
  }
  body.addEventListener("click", (event) => {
    const row = event.target.closest("tr");
    if (row) state.choose(state.setups[Number(row.dataset.index)], "table");
  });
  byId("setups").replaceChildren(sortingHead(columns, sort, act), body);
  byId("count").textContent = `${members.length.toLocaleString("en")} setups${members.length > state.shownRows ? `, ${state.shownRows} shown` : ""}`;
  byId("more").hidden = members.length <= state.shownRows;
  markRows(state, false);
}

/** Mark the chosen and the kept row; bring the chosen one into sight if `scroll`. */
function markRows(state, scroll) {
  for (const row of byId("setups").querySelectorAll("tbody tr")) {
    const index = Number(row.dataset.index), chosen = index === state.chosen?.index;
    row.className = chosen ? "chosen" : index === state.kept?.index ? "kept" : "";
    row.toggleAttribute("aria-current", chosen);
    if (chosen && scroll) {
      const box = row.closest(".scroll"), top = row.offsetTop - 40;
      if (top < box.scrollTop || top > box.scrollTop + box.clientHeight - 80) box.scrollTop = top - box.clientHeight / 3;
    }
  }
}
