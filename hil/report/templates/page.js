/* What the page can do beyond being read: copy its tables, and zoom into its plots over time.
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

  /* Paper cannot be unfolded ---------------------------------------------------------------- */

  var unfolded = [];
  window.addEventListener("beforeprint", function () {
    unfolded = Array.prototype.slice.call(document.querySelectorAll("details:not([open])"));
    unfolded.forEach(function (part) { part.open = true; });
  });
  window.addEventListener("afterprint", function () {
    unfolded.forEach(function (part) { part.open = false; });
  });

  /* Zooming into plots over time ---------------------------------------------------------- */

  var SVG = "http://www.w3.org/2000/svg";
  var MOST = 1000;      /* points of a line that are drawn at once */
  var CLOSEST = 0.002;  /* of the whole time */
  var NOTHING = 65535;  /* stands where nothing was recorded */

  function element(name, attributes, parent) {
    var made = document.createElementNS(SVG, name);
    for (var key in attributes) made.setAttribute(key, attributes[key]);
    if (parent) parent.appendChild(made);
    return made;
  }

  function samples(line) {
    var bytes = atob(line.data), found = new Float64Array(bytes.length / 2);
    for (var k = 0; k < found.length; k++) {
      var count = bytes.charCodeAt(2 * k) + 256 * bytes.charCodeAt(2 * k + 1);
      found[k] = count === NOTHING ? NaN : line.low + line.step * count;
    }
    return found;
  }

  function ticks(low, high, most) {
    var rough = (high - low) / most, size = Math.pow(10, Math.floor(Math.log10(rough)));
    var step = [1, 2, 5, 10].map(function (f) { return f * size; })
      .find(function (s) { return s >= rough * 0.999; });
    var decimals = Math.max(0, -Math.floor(Math.log10(step) + 1e-9)), found = [];
    for (var k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++)
      found.push({ at: k * step, text: (k * step).toFixed(decimals).replace(/^-(0\.?0*)$/, "$1") });
    return found;
  }

  function lines(plot) {
    if (!plot.decoded) plot.decoded = plot.lines.map(samples);
    return plot.decoded;
  }

  /* Indices of the samples to draw: all, or the lowest and highest of each stretch. */
  function chosen(values, first, last) {
    var count = last - first + 1, found = [];
    if (count <= MOST) {
      for (var k = first; k <= last; k++) found.push(k);
      return found;
    }
    var stretches = MOST / 2;
    for (var s = 0; s < stretches; s++) {
      var from = first + Math.floor(s * count / stretches);
      var to = first + Math.floor((s + 1) * count / stretches), low = from, high = from;
      for (var i = from; i < to; i++) {
        if (values[i] < values[low] || isNaN(values[low])) low = i;
        if (values[i] > values[high] || isNaN(values[high])) high = i;
      }
      found.push(Math.min(low, high));
      if (low !== high) found.push(Math.max(low, high));
    }
    return found;
  }

  function between(values, place) {
    var k = Math.min(Math.floor(place), values.length - 2);
    return values[k] + (place - k) * (values[k + 1] - values[k]);
  }

  function drawPlot(group, plot, content, view, isLast) {
    var box = plot.box, left = box[0], top = box[1], wide = box[2], tall = box[3];
    var low = Infinity, high = -Infinity, begin = content.begin;
    function reach(v) {
      if (v < low) low = v;
      if (v > high) high = v;
    }
    lines(plot).forEach(function (values) {
      var scale = (values.length - 1) / content.end;
      [view.from, view.to].forEach(function (t) { reach(between(values, t * scale)); });
      for (var k = Math.ceil(view.from * scale); k <= view.to * scale; k++) reach(values[k]);
    });
    if (low > high) low = high = 0;
    var room = 0.06 * (high - low) || Math.abs(high) * 0.01 || 1e-9;
    low -= room;
    high += room;
    function x(t) { return left + wide * (t - view.from) / (view.to - view.from); }
    function y(v) { return top + tall * (high - v) / (high - low); }
    function upright(t, kind) {
      element("path", { d: "M" + x(t) + " " + top + "v" + tall, "class": kind }, group);
    }
    plot.shaded.forEach(function (stretch) {
      var from = Math.max(stretch[0], view.from), to = Math.min(stretch[1], view.to);
      if (to > from) element("rect", { x: x(from), y: top, width: x(to) - x(from), height: tall,
        "class": "zoom-shade" }, group);
    });
    ticks(view.from + begin, view.to + begin, 6).forEach(function (tick) {
      upright(tick.at - begin, "zoom-grid");
      if (isLast) element("text", { x: x(tick.at - begin), y: top + tall + 14, "text-anchor": "middle",
        "class": "zoom-tick" }, group).textContent = tick.text;
    });
    ticks(low, high, tall > 90 ? 5 : 4).forEach(function (tick) {
      element("path", { d: "M" + left + " " + y(tick.at) + "h" + wide, "class": "zoom-grid" }, group);
      element("text", { x: left - 5, y: y(tick.at) + 3.8, "text-anchor": "end",
        "class": "zoom-tick" }, group).textContent = tick.text.replace("-", "\u2212");
    });
    element("path", { d: "M" + left + " " + top + "v" + tall + "h" + wide, "class": "zoom-frame" }, group);
    element("text", { x: left, y: top - 6, "class": "zoom-head" }, group).textContent = plot.heading;
    if (isLast) element("text", { x: left + wide / 2, y: top + tall + 30, "text-anchor": "middle",
      "class": "zoom-head" }, group).textContent = "time [s]";
    content.marks.filter(function (t) { return t >= view.from && t <= view.to; })
      .forEach(function (t) { upright(t, "zoom-mark"); });
    plot.limits.filter(function (v) { return v >= low && v <= high; }).forEach(function (v) {
      element("path", { d: "M" + left + " " + y(v) + "h" + wide, "class": "zoom-limit" }, group);
    });
    plot.lines.forEach(function (line, number) {
      var values = lines(plot)[number], scale = (values.length - 1) / content.end;
      var first = Math.ceil(view.from * scale), last = Math.floor(view.to * scale);
      var path = "", pen = "M";
      function to(t, v) {
        if (isNaN(v)) pen = "M";
        else path += pen + x(t).toFixed(2) + " " + y(v).toFixed(2), pen = "L";
      }
      to(view.from, between(values, view.from * scale));
      if (last >= first) chosen(values, first, last).forEach(function (k) { to(k / scale, values[k]); });
      to(view.to, between(values, view.to * scale));
      element("path", { d: path, "class": "zoom-line",
        style: "stroke:" + line.colour + ";stroke-width:" + line.width }, group);
    });
  }

  function Zoom(panels) {
    var svgs = Array.prototype.slice.call(panels.querySelectorAll("svg[data-traces]"));
    var contents = svgs.map(function (svg) { return JSON.parse(svg.dataset.traces); });
    var begin = contents[0].begin, end = contents[0].end, view = { from: 0, to: end }, waiting = false, cursor = null;
    var fingers = new Map(), drag = null;

    function isWhole() { return view.to - view.from >= end * (1 - 1e-9); }

    function show(from, to) {
      var wide = Math.min(Math.max(to - from, CLOSEST * end), end);
      var middle = (from + to) / 2;
      from = Math.min(Math.max(middle - wide / 2, 0), end - wide);
      view = { from: from, to: from + wide };
      if (!waiting) {
        waiting = true;
        requestAnimationFrame(function () { waiting = false; draw(); });
      }
    }

    function scale(factor, about) {
      var at = about === undefined ? (view.from + view.to) / 2 : about;
      show(at - (at - view.from) * factor, at + (view.to - at) * factor);
    }

    function move(share) {
      var by = share * (view.to - view.from);
      by = Math.min(Math.max(by, -view.from), end - view.to);
      show(view.from + by, view.to + by);
    }

    function layer(svg, name) {
      var found = svg.querySelector("g." + name);
      return found || element("g", { "class": name }, svg);
    }

    function draw() {
      svgs.forEach(function (svg, number) {
        var group = layer(svg, "zoom-view"), content = contents[number];
        group.textContent = "";
        svg.classList.toggle("zoomed", !isWhole());
        if (!isWhole()) content.plots.forEach(function (plot, k) {
          drawPlot(group, plot, content, view, k === content.plots.length - 1);
        });
      });
      range.textContent = isWhole() ? "whole motion" :
        (view.from + begin).toFixed(2) + " to " + (view.to + begin).toFixed(2) + " s";
      buttons.forEach(function (one) { one.made.disabled = one.needsZoom && isWhole(); });
      drawCursor();
    }

    function drawCursor() {
      svgs.forEach(function (svg, number) {
        var group = layer(svg, "zoom-cursor"), content = contents[number];
        svg.appendChild(group);
        group.textContent = "";
        content.plots.forEach(function (plot) {
          var left = plot.box[0], top = plot.box[1], wide = plot.box[2], tall = plot.box[3];
          function x(t) { return left + wide * (t - view.from) / (view.to - view.from); }
          if (drag && drag.select) {
            var ends = [x(drag.from), x(drag.to)].sort(function (a, b) { return a - b; });
            element("rect", { x: ends[0], y: top, width: ends[1] - ends[0], height: tall,
              "class": "zoom-selection" }, group);
          }
          if (cursor === null || cursor < view.from || cursor > view.to) return;
          element("path", { d: "M" + x(cursor) + " " + top + "v" + tall, "class": "zoom-hair" }, group);
          var text = element("text", { x: left + wide, y: top - 6, "text-anchor": "end",
            "class": "zoom-tick" }, group);
          plot.lines.forEach(function (line, k) {
            var values = lines(plot)[k];
            var value = between(values, cursor * (values.length - 1) / content.end);
            var part = element("tspan", { dx: k ? 6 : 0 }, text);
            part.textContent = isNaN(value) ? "\u2013" :
              Number(value.toPrecision(3)).toString().replace("-", "\u2212");
            if (plot.lines.length > 1) part.textContent = line.name + " " + part.textContent;
          });
        });
      });
      if (cursor !== null) where.textContent = "t = " + (cursor + begin).toFixed(3) + " s";
      else where.textContent = "";
    }

    function timeAt(svg, event) {
      var number = svgs.indexOf(svg), box = contents[number].plots[0].box;
      var rect = svg.getBoundingClientRect();
      var x = (event.clientX - rect.left) / rect.width * svg.viewBox.baseVal.width;
      var share = Math.min(Math.max((x - box[0]) / box[2], 0), 1);
      return view.from + share * (view.to - view.from);
    }

    function pinch(svg) {
      var two = Array.from(fingers.values());
      return { distance: Math.abs(two[0].clientX - two[1].clientX) + 1,
        at: timeAt(svg, { clientX: (two[0].clientX + two[1].clientX) / 2 }) };
    }

    function down(svg, event) {
      fingers.set(event.pointerId, event);
      if (fingers.size === 2) {
        drag = null;
        return;
      }
      if (event.pointerType === "mouse" && event.button !== 0) return;
      var at = timeAt(svg, event), pans = event.pointerType === "touch" || event.shiftKey;
      drag = { select: !pans, pans: pans, from: at, to: at };
      if (!pans) {
        svg.setPointerCapture(event.pointerId);
        event.preventDefault();
      }
    }

    function moved(svg, event) {
      if (fingers.size === 2 && fingers.has(event.pointerId)) {
        var before = pinch(svg);
        fingers.set(event.pointerId, event);
        var after = pinch(svg);
        scale(before.distance / after.distance, before.at);
        return;
      }
      var at = timeAt(svg, event);
      cursor = at;
      if (drag && drag.pans) show(view.from + drag.from - at, view.to + drag.from - at);
      else if (drag) drag.to = at;
      drawCursor();
    }

    function up(event) {
      fingers.delete(event.pointerId);
      var done = drag;
      drag = null;
      if (done && done.select && Math.abs(done.to - done.from) > 0.01 * (view.to - view.from))
        show(Math.min(done.from, done.to), Math.max(done.from, done.to));
      else drawCursor();
    }

    function key(event) {
      var acts = { "+": function () { scale(0.5); }, "=": function () { scale(0.5); },
        "-": function () { scale(2); }, "ArrowLeft": function () { move(-0.25); },
        "ArrowRight": function () { move(0.25); }, "0": whole, "Escape": whole };
      if (event.ctrlKey || event.metaKey || event.altKey || !acts[event.key]) return;
      acts[event.key]();
      event.preventDefault();
    }

    function whole() { show(0, end); }

    svgs.forEach(function (svg) {
      svg.addEventListener("pointerdown", down.bind(null, svg));
      svg.addEventListener("pointermove", moved.bind(null, svg));
      svg.addEventListener("pointerup", up);
      svg.addEventListener("pointercancel", up);
      svg.addEventListener("pointerleave", function (event) {
        if (drag && drag.select) return;
        cursor = null;
        if (event.pointerType !== "mouse") up(event);
        drawCursor();
      });
      svg.addEventListener("dblclick", whole);
      svg.addEventListener("wheel", function (event) {
        if (!event.ctrlKey && !event.shiftKey) return; /* the page scrolls */
        event.preventDefault();
        scale((event.deltaY || event.deltaX) > 0 ? 1.25 : 0.8, timeAt(svg, event));
      }, { passive: false });
    });

    var bar = document.createElement("div");
    bar.className = "zoom-bar";
    bar.setAttribute("role", "group");
    bar.setAttribute("aria-label", "Zoom over time");
    var buttons = [
      ["Zoom in", "+", function () { scale(0.5); }, false],
      ["Zoom out", "\u2212", function () { scale(2); }, true],
      ["Earlier", "\u2190", function () { move(-0.25); }, true],
      ["Later", "\u2192", function () { move(0.25); }, true],
      ["Whole motion", "Whole", whole, true]
    ].map(function (one) {
      var made = document.createElement("button");
      made.type = "button";
      made.textContent = one[1];
      made.setAttribute("aria-label", one[0]);
      made.title = one[0];
      made.addEventListener("click", one[2]);
      bar.appendChild(made);
      return { made: made, needsZoom: one[3] };
    });
    var range = document.createElement("span"), where = document.createElement("span");
    var hint = document.createElement("span");
    range.setAttribute("aria-live", "polite");
    hint.className = "hint";
    hint.textContent = "Drag across a plot, pinch, or use + \u2212 \u2190 \u2192 0.";
    bar.append(range, hint, where);
    panels.parentNode.insertBefore(bar, panels);
    panels.tabIndex = 0;
    panels.setAttribute("role", "group");
    panels.setAttribute("aria-label", "Plots over time: plus and minus zoom, arrows move, 0 shows all");
    panels.addEventListener("keydown", key);
    bar.addEventListener("keydown", key);
    draw();
  }

  document.querySelectorAll(".panels").forEach(function (panels) {
    if (panels.querySelector("svg[data-traces]")) Zoom(panels);
  });
})();
