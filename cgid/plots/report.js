"use strict";
// Without this script the tables stand in order of time, and nothing else is missing.
const PAGE = 200;
for (const table of document.querySelectorAll("table.answers")) {
  const body = table.tBodies[0], heads = Array.from(table.tHead.rows[0].cells);
  const inTime = Array.from(body.rows);
  let rows = inTime, page = 0;
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
      const keyed = inTime.map((row, place) => [key(row, column), place, row]);
      keyed.sort(([a, i], [b, j]) => {
        // What is missing comes last, whichever way; equals stay in order of time.
        if (a === null || b === null) return (a === null) - (b === null) || i - j;
        const order = typeof a === "number" ? a - b : a.localeCompare(b, undefined, { numeric: true });
        return (up ? order : -order) || i - j;
      });
      rows = keyed.map(([, , row]) => row);
      body.append(...rows);
      page = 0;
      show();
    });
  });
  const choose = table.closest(".impacts").querySelector(".choose"), shown = choose.querySelector("output");
  const selects = Array.from(choose.querySelectorAll("select"));
  const pages = document.createElement("p"), where = document.createElement("output");
  pages.className = "pages";
  const turns = [["Back", -1], ["Next", 1]].map(([text, step]) => {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = text;
    button.addEventListener("click", () => { page += step; show(); });
    return button;
  });
  pages.append(turns[0], where, turns[1]);
  table.parentElement.after(pages);
  const fits = row => selects.every(one => one.value === "" || row.cells[one.dataset.column].textContent.trim() === one.value);
  const show = () => {
    let count = 0;
    for (const row of rows) {
      const chosen = fits(row);
      row.hidden = !chosen || Math.floor(count / PAGE) !== page;
      count += chosen;
    }
    const last = Math.max(Math.ceil(count / PAGE), 1) - 1;
    turns[0].disabled = page === 0;
    turns[1].disabled = page === last;
    where.textContent = `page ${page + 1} of ${last + 1}`;
    pages.hidden = last === 0;
    shown.textContent = `${count} of ${rows.length} rows`;
  };
  // On paper all rows that were chosen stand in one table.
  addEventListener("beforeprint", () => {
    for (const row of rows) row.hidden = !fits(row);
  });
  addEventListener("afterprint", show);
  selects.forEach(one => one.addEventListener("change", () => { page = 0; show(); }));
  choose.hidden = false;
  show();
}
