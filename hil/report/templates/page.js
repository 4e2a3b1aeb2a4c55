/* What the page can do beyond being read: copy its tables.
   Without it the page is whole. Text only ever enters as text. */
(function () {
  "use strict";

  /* Copying tables ------------------------------------------------------------------------ */

  function cellText(cell) {
    var text = cell.textContent.replace(/\s+/g, " ").trim();
    /* A spreadsheet would compute what begins like this; numbers may. */
    return /^[=+@-]/.test(text) && isNaN(Number(text)) ? "'" + text : text;
  }

  function tableText(table) {
    return Array.prototype.map.call(table.rows, function (row) {
      var cells = [];
      Array.prototype.forEach.call(row.cells, function (cell) {
        cells.push(cellText(cell));
        for (var k = 1; k < cell.colSpan; k++) cells.push("");
      });
      return cells.join("\t");
    }).join("\n") + "\n";
  }

  function copiedByHand(text) {
    var area = document.createElement("textarea");
    area.value = text;
    area.style.position = "fixed";
    area.style.opacity = "0";
    document.body.appendChild(area);
    area.select();
    var done = false;
    try { done = document.execCommand("copy"); } catch (error) { done = false; }
    area.remove();
    return done;
  }

  function copy(text, tell) {
    if (navigator.clipboard && window.isSecureContext) {
      navigator.clipboard.writeText(text).then(
        function () { tell(true); }, function () { tell(copiedByHand(text)); });
    } else tell(copiedByHand(text));
  }

  function addCopyButton(table) {
    var place = table.caption && (table.caption.querySelector("span") || table.caption);
    if (!place) return;
    var button = document.createElement("button");
    button.type = "button";
    button.className = "copy";
    button.textContent = "Copy table";
    button.setAttribute("aria-live", "polite");
    button.addEventListener("click", function () {
      copy(tableText(table), function (done) {
        button.textContent = done ? "Copied" : "Not copied: select and copy it";
        setTimeout(function () { button.textContent = "Copy table"; }, 2000);
      });
    });
    place.appendChild(document.createTextNode(" "));
    place.appendChild(button);
  }

  document.querySelectorAll("table").forEach(addCopyButton);

  /* Paper cannot be unfolded. Appendix and essential parameters, most of the pages, are printed if they are open. */

  var unfolded = [];
  window.addEventListener("beforeprint", function () {
    unfolded = Array.prototype.slice.call(document.querySelectorAll("details:not([open]):not(#appendix):not(.essential)"));
    unfolded.forEach(function (part) { part.open = true; });
  });
  window.addEventListener("afterprint", function () {
    unfolded.forEach(function (part) { part.open = false; });
  });
})();
