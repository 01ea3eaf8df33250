"use strict";

// Tables are sorted by the buttons in their headings; what has no value stays at the end either way.
for (const table of document.querySelectorAll("table.standings")) {
  const body = table.tBodies[0];
  const headings = [...table.tHead.rows[0].cells];
  const value = (row, column) => row.cells[column].dataset.value;
  const sort = (column, direction) => {
    const rows = [...body.rows];
    const order = (a, b) => {
      const [x, y] = [value(a, column), value(b, column)];
      if (x === undefined || y === undefined) return (x === undefined) - (y === undefined);
      const both = Number(x) - Number(y);
      return direction * (Number.isNaN(both) ? x.localeCompare(y) : both);
    };
    rows.sort(order).forEach((row) => body.append(row));
    headings.forEach((heading) => heading.removeAttribute("aria-sort"));
    headings[column].setAttribute("aria-sort", direction > 0 ? "ascending" : "descending");
  };
  headings.forEach((heading, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...heading.childNodes);
    heading.append(button);
    button.addEventListener("click", () => {
      sort(column, heading.getAttribute("aria-sort") === "ascending" ? -1 : 1);
    });
  });
}

// A legend's buttons bring the lines of their models forward in every chart of the board.
for (const board of document.querySelectorAll(".board")) {
  const buttons = [...board.querySelectorAll(".legend button")];
  const series = [...board.querySelectorAll(".charts .series")];
  const refresh = () => {
    const chosen = buttons.filter((button) => button.getAttribute("aria-pressed") === "true");
    const models = new Set(chosen.map((button) => button.dataset.model));
    board.querySelector(".charts").classList.toggle("faded", models.size > 0);
    series.forEach((one) => one.classList.toggle("chosen", models.has(one.dataset.model)));
  };
  for (const button of buttons) {
    button.addEventListener("click", () => {
      button.setAttribute("aria-pressed", String(button.getAttribute("aria-pressed") !== "true"));
      refresh();
    });
  }
}

// The element that a link's end names; none for what no link of this page says, such as a lone percent sign.
const named = (name) => {
  try {
    return document.getElementById(decodeURIComponent(name));
  } catch {
    return null;
  }
};

// A link to an entry unfolds it.
const unfold = () => {
  const target = named(location.hash.slice(1));
  if (target instanceof HTMLDetailsElement) {
    target.open = true;
    target.scrollIntoView();
  }
};
addEventListener("hashchange", unfold);
document.addEventListener("click", (event) => {
  const link = event.target.closest?.('a[href^="#"]');
  if (link && link.hash === location.hash) unfold();
});
unfold();
