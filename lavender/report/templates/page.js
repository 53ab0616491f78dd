"use strict";
(function () {
  const every = (selector, from) => Array.from((from || document).querySelectorAll(selector));

  // -- copying -------------------------------------------------------------------------------------
  const copy = document.getElementById("copy");
  if (copy && navigator.clipboard) {
    copy.hidden = false;
    copy.addEventListener("click", () => {
      navigator.clipboard.writeText(document.querySelector(".code pre").textContent);
      copy.textContent = "copied";
    });
  }

  // -- tables: sorted by a column, with pointer or keyboard ----------------------------------------
  every("table.sortable").forEach((table) => {
    const heads = every("thead th", table);
    heads.forEach((head, column) => {
      head.tabIndex = 0;
      const key = (row) => {
        const cell = row.cells[column];
        const number = parseFloat(cell.textContent);
        return !cell.querySelector(".n") ? cell.textContent.toLowerCase() : isNaN(number) ? Infinity : number;
      };
      const sort = () => {
        const down = head.getAttribute("aria-sort") === "ascending";
        heads.forEach((h) => h.removeAttribute("aria-sort"));
        head.setAttribute("aria-sort", down ? "descending" : "ascending");
        const rows = every("tbody tr", table);
        rows.sort((a, b) => (key(a) < key(b) ? -1 : key(a) > key(b) ? 1 : 0) * (down ? -1 : 1));
        table.tBodies[0].append(...rows);
      };
      head.addEventListener("click", sort);
      head.addEventListener("keydown", (event) => { if (event.key === "Enter") sort(); });
    });
  });

  // -- links open the part that they lead to; print opens every part -------------------------------
  function follow() {
    const target = location.hash ? document.getElementById(decodeURIComponent(location.hash.slice(1))) : null;
    for (let part = target; part; part = part.parentElement) if (part.tagName === "DETAILS") part.open = true;
    if (target) target.scrollIntoView();
  }
  addEventListener("hashchange", follow);
  follow();
  let opened = [];
  addEventListener("beforeprint", () => {
    opened = every("details:not([open])");
    opened.forEach((d) => { d.open = true; });
  });
  addEventListener("afterprint", () => opened.forEach((d) => { d.open = false; }));
})();
