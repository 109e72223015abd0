"use strict";
// Without this script the tables stand in order of time, and nothing else is missing.
for (const table of document.querySelectorAll("table.answers")) {
  const body = table.tBodies[0], rows = Array.from(body.rows), heads = Array.from(table.tHead.rows[0].cells);
  const key = (row, column) => {
    const cell = row.cells[column], text = cell.dataset.value ?? cell.textContent.trim();
    if (text === "" || text === "-") return null;
    return heads[column].classList.contains("number") ? Number(text) : text;
  };
  heads.forEach((head, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = head.textContent;
    head.replaceChildren(button);
    button.addEventListener("click", () => {
      const up = head.getAttribute("aria-sort") !== "ascending";
      heads.forEach(other => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", up ? "ascending" : "descending");
      const keyed = rows.map((row, place) => [key(row, column), place, row]);
      keyed.sort(([a, i], [b, j]) => {
        // What is missing comes last, whichever way; equals stay in order of time.
        if (a === null || b === null) return (a === null) - (b === null) || i - j;
        const order = typeof a === "number" ? a - b : a.localeCompare(b, undefined, { numeric: true });
        return (up ? order : -order) || i - j;
      });
      body.append(...keyed.map(([, , row]) => row));
    });
  });
  const choose = table.closest(".impacts").querySelector(".choose"), shown = choose.querySelector("output");
  const selects = Array.from(choose.querySelectorAll("select"));
  const show = () => {
    let count = 0;
    for (const row of rows) {
      const hidden = selects.some(one => one.value !== "" && row.cells[one.dataset.column].textContent.trim() !== one.value);
      row.hidden = hidden;
      count += !hidden;
    }
    shown.textContent = `${count} of ${rows.length} rows`;
  };
  selects.forEach(one => one.addEventListener("change", show));
  choose.hidden = false;
  show();
}
