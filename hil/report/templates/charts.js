/* Interactive charts in place of the pictures, with BokehJS. Without it the pictures stay.
   Text only ever enters as text. */
(function () {
  "use strict";

  var source = document.getElementById("chart-data");
  if (!source || !window.Bokeh || !window.Bokeh.Plotting) return;
  var data = JSON.parse(source.textContent);
  var Bokeh = window.Bokeh, Plotting = Bokeh.Plotting;
  Bokeh.set_log_level("error");
  var LOOSE = 1.0; /* A loose line adds at most the length of the range on each side. */
  var MARGIN = 0.05;
  var coarse = window.matchMedia("(pointer: coarse)").matches;
  var hiddenTraces = {};

  function decoded(part) {
    var bytes = atob(part.codes), count = bytes.length / 2, values = new Float64Array(count);
    for (var k = 0; k < count; k++) {
      var code = bytes.charCodeAt(2 * k) | (bytes.charCodeAt(2 * k + 1) << 8);
      if (code > 32767) code -= 65536;
      values[k] = code === -32768 ? NaN : part.middle + part.step * code;
    }
    return values;
  }

  function colour(name) {
    return getComputedStyle(document.documentElement).getPropertyValue(name).trim() || "#888888";
  }

  /* Groups: charts that share their axis of x, and their controls ---------------------------- */

  function Group(name, charts, figure) {
    this.name = name;
    this.figure = figure;
    this.charts = charts;
    this.views = [];
    this.drag = coarse ? null : "zoom";
    this.built = false;
    this.roots = [];
    this.holders = [];
  }

  /* Axes of time are linked over all figures but those of other motions, those of frequency within
     one, and a chart may have its own. A document of Bokeh's has models of its own, so the axes
     of two figures follow each other here. */
  var axes = [];
  var OF_OTHER_MOTIONS = /^(excitation$|motion-)/;

  function axisOf(group, chart) {
    var link = chart.foot.indexOf("time") === 0 && !OF_OTHER_MOTIONS.test(group.name) ? "time" : group.name;
    var key = group.name + (chart.own ? chart.key : "");
    var axis = axes.find(function (other) { return other.key === key; });
    if (axis) return axis;
    var range = new Bokeh.Range1d({ start: chart.range[0], end: chart.range[1] });
    axis = { key: key, link: link, range: range, views: [], first: chart.range.slice(), pending: false };
    axis.cursor = new Bokeh.Span({ dimension: "height", line_width: 1, line_dash: [3, 3] });
    axes.push(axis);
    axes.forEach(function (other) {
      if (other.link === link && link === "time") range.setv({ start: other.range.start, end: other.range.end });
    });
    var follow = function () {
      if (axis.pending) return;
      axis.pending = true;
      window.requestAnimationFrame(function () {
        axis.pending = false;
        axis.views.forEach(fitHeight);
        axes.forEach(function (other) {
          if (other !== axis && link === "time" && other.link === link) moveTo(other, range.start, range.end);
        });
      });
    };
    range.properties.start.change.connect(follow);
    range.properties.end.change.connect(follow);
    return axis;
  }

  function moveTo(axis, start, end) {
    if (axis.range.start !== start || axis.range.end !== end) axis.range.setv({ start: start, end: end });
  }

  function whole(shared) {
    return shared.range.start === shared.first[0] && shared.range.end === shared.first[1];
  }

  /* The vertical axis shows what is inside the horizontal one. */
  function fitHeight(view) {
    var shared = view.shared, low = Infinity, high = -Infinity, looseLow = Infinity, looseHigh = -Infinity;
    if (view.plot.fixed && whole(shared)) {
      view.y.setv({ start: view.limits[0], end: view.limits[1] });
      return;
    }
    view.lines.forEach(function (line) {
      if (!line.glyph.visible) return;
      for (var k = 0; k < line.x.length; k++) {
        var value = line.y[k];
        if (line.x[k] < shared.range.start || line.x[k] > shared.range.end || !isFinite(value)) continue;
        if (line.loose) {
          if (value < looseLow) looseLow = value;
          if (value > looseHigh) looseHigh = value;
        } else {
          if (value < low) low = value;
          if (value > high) high = value;
        }
      }
    });
    if (low > high) { low = looseLow; high = looseHigh; }
    if (low > high) return;
    if (view.chart.log) {
      view.y.setv({ start: low / 1.4, end: high * 1.4 });
      return;
    }
    var span = high - low || Math.abs(high) || 1;
    low = Math.min(low, Math.max(looseLow, low - LOOSE * span));
    high = Math.max(high, Math.min(looseHigh, high + LOOSE * span));
    var margin = MARGIN * (high - low) || 0.5;
    view.y.setv({ start: low - margin, end: high + margin });
  }

  function format(span) {
    var digits = Math.max(0, Math.min(6, 3 - Math.floor(Math.log10(span || 1))));
    return "{0." + new Array(digits + 1).join("0") + "}";
  }

  function unitOf(heading) {
    var found = /\[([^\]]*)\]/.exec(heading);
    return found ? " " + found[1] : "";
  }

  function style(view) {
    var figure = view.figure, ink = colour("--ink"), muted = colour("--muted"), grid = colour("--grid");
    figure.setv({
      background_fill_color: colour("--paper"), border_fill_color: colour("--paper"),
      outline_line_color: null
    });
    figure.axis.each(function (axis) {
      axis.setv({
        axis_line_color: muted, major_tick_line_color: muted, minor_tick_line_color: null,
        major_label_text_color: ink, axis_label_text_color: muted, axis_label_text_font_style: "normal",
        axis_label_text_font_size: "11px", major_label_text_font_size: "11px", axis_label_standoff: 4
      });
    });
    figure.grid.each(function (lines) { lines.grid_line_color = grid; });
    view.lines.forEach(function (line) {
      var shade = colour(line.trace.colour), glyph = line.glyph.glyph;
      if (line.trace.dots) glyph.setv({ fill_color: shade, line_color: null });
      else glyph.line_color = shade;
    });
    view.strips.forEach(function (strip) { strip.glyph.setv({ fill_color: colour("--band"), line_color: null }); });
    view.cursor.line_color = muted;
    view.zeros.forEach(function (zero) { zero.line_color = muted; });
  }

  function build(group, chart, place) {
    var shared = axisOf(group, chart), sharedX = decoded(chart.x);
    chart.plots.forEach(function (plot, k) {
      var last = k === chart.plots.length - 1;
      var y = new Bokeh.Range1d({ start: plot.limits[0], end: plot.limits[1] });
      var figure = new Plotting.figure({
        x_range: shared.range, y_range: y, height: Math.round(plot.height * 1.25) + (last ? 52 : 26),
        sizing_mode: "stretch_width", tools: [], toolbar_location: null,
        x_axis_type: chart.log ? "log" : "linear", y_axis_type: chart.log ? "log" : "linear",
        title: plot.heading, min_border_left: 52, min_border_right: 8, min_border_top: 4,
        x_axis_label: last ? chart.foot : null, name: chart.key + "-" + k
      });
      figure.title.setv({
        text_font_size: "11px", text_font_style: "normal", text_color: colour("--muted"), standoff: 3
      });
      var view = {
        figure: figure, plot: plot, chart: chart, shared: shared, y: y, limits: plot.limits,
        lines: [], strips: [], zeros: [], group: group, name: chart.key + "-" + k
      };
      if (chart.log) figure.xaxis.each(function (axis) {
        // A few instants are each a tick; of a spectrum round ones are.
        if (sharedX.length <= 6) axis.ticker = new Bokeh.FixedTicker({ ticks: Array.from(sharedX) });
        else axis.ticker.desired_num_ticks = 4;
      });
      if (!chart.log) figure.yaxis.each(function (axis) { axis.ticker.desired_num_ticks = plot.height > 80 ? 5 : 4; });
      if (!last) figure.xaxis.each(function (axis) { axis.visible = false; });
      if (plot.shaded.length) {
        view.strips.push(figure.vstrip({
          x0: plot.shaded.map(function (ends) { return ends[0]; }),
          x1: plot.shaded.map(function (ends) { return ends[1]; })
        }));
      }
      if (plot.band) {
        view.strips.push(figure.hstrip({ y0: [plot.band[0]], y1: [plot.band[1]] }));
      }
      if (plot.origin) {
        ["width", "height"].forEach(function (dimension) {
          var zero = new Bokeh.Span({ location: 0, dimension: dimension, line_width: 1 });
          figure.add_layout(zero);
          view.zeros.push(zero);
        });
      }
      plot.traces.forEach(function (trace) {
        var x = trace.x ? decoded(trace.x) : sharedX, values = decoded(trace.y);
        if (chart.log) values = values.map(function (value) { return Math.pow(10, value); });
        var columns = new Bokeh.ColumnDataSource({ data: { x: x, y: values } });
        var settings = { source: columns, name: trace.name };
        var glyph;
        if (trace.dots) {
          glyph = figure.scatter({ field: "x" }, { field: "y" }, Object.assign(settings, { size: trace.width * 1.5 }));
        } else {
          glyph = figure.line({ field: "x" }, { field: "y" }, Object.assign(settings, {
            line_width: trace.width * 1.2, line_dash: trace.dashed ? [5, 4] : [], line_join: "round"
          }));
        }
        glyph.visible = !hiddenTraces[traceKey(group.name, trace.name)];
        view.lines.push({ trace: trace, glyph: glyph, x: x, y: values, loose: trace.loose });
      });
      addTools(view);
      style(view);
      group.views.push(view);
      shared.views.push(view);
      var holder = document.createElement("div");
      holder.className = "plot-holder";
      place.appendChild(holder);
      group.roots.push(figure);
      group.holders.push(holder);
    });
  }

  /* One cursor of time in all charts that share it, and the values beside the pointer. */
  function addTools(view) {
    var shared = view.shared, unit = unitOf(view.plot.heading), figure = view.figure;
    view.cursor = shared.cursor;
    var axis = view.chart.foot.split(" [")[0], axisUnit = unitOf(view.chart.foot);
    var lines = view.lines.filter(function (line) { return !line.trace.dots; });
    var leader = lines[lines.length - 1];
    var data = { x: leader.x };
    var tips = [[axis, "@x" + format(shared.first[1] - shared.first[0]) + axisUnit]];
    lines.forEach(function (line, k) {
      if (line.x !== leader.x) return;
      data["y" + k] = line.y;
      var size = view.limits[1] - view.limits[0];
      tips.push([line.trace.name, "@y" + k + (view.chart.log ? "{0.000e0}" : format(size / 10)) + unit]);
    });
    data.at = leader.y;
    var carrier = figure.line({ field: "x" }, { field: "at" }, {
      source: new Bokeh.ColumnDataSource({ data: data }), line_alpha: 0
    });
    view.carrier = carrier;
    view.hover = new Bokeh.HoverTool({
      renderers: [carrier], mode: "vline", tooltips: tips, line_policy: "nearest",
      point_policy: "follow_mouse", attachment: "horizontal"
    });
    view.zoom = new Bokeh.BoxZoomTool({ dimensions: view.chart.log || view.plot.origin ? "both" : "width" });
    view.pan = new Bokeh.PanTool({ dimensions: view.chart.log || view.plot.origin ? "both" : "width" });
    var wheel = new Bokeh.WheelZoomTool({ dimensions: "width", modifiers: { ctrl: true }, zoom_on_axis: false });
    var crosshair = new Bokeh.CrosshairTool({ overlay: shared.cursor, dimensions: "height" });
    figure.add_tools(view.hover, view.zoom, view.pan, wheel, crosshair);
    figure.toolbar.active_scroll = wheel;
    setDrag(view, view.group.drag);
  }

  function setDrag(view, what) {
    view.figure.toolbar.active_drag = what === "zoom" ? view.zoom : what === "pan" ? view.pan : null;
  }

  function traceKey(group, name) { return group + "/" + name; }

  /* Controls ------------------------------------------------------------------------------- */

  function button(text, pressed, act) {
    var item = document.createElement("button");
    item.type = "button";
    item.textContent = text;
    if (pressed !== null) item.setAttribute("aria-pressed", String(pressed));
    item.addEventListener("click", act);
    return item;
  }

  function addControls(group) {
    var bar = document.createElement("div");
    bar.className = "tools";
    bar.setAttribute("role", "toolbar");
    bar.setAttribute("aria-label", "Charts");
    var modes = {};
    ["zoom", "pan"].forEach(function (mode) {
      modes[mode] = button(mode === "zoom" ? "Drag: zoom" : "Drag: pan", group.drag === mode, function () {
        group.drag = group.drag === mode && coarse ? null : mode;
        Object.keys(modes).forEach(function (key) {
          modes[key].setAttribute("aria-pressed", String(group.drag === key));
        });
        group.views.forEach(function (view) { setDrag(view, group.drag); });
      });
      bar.appendChild(modes[mode]);
    });
    bar.appendChild(button("Whole range", null, function () {
      group.views.forEach(function (view) {
        moveTo(view.shared, view.shared.first[0], view.shared.first[1]);
        fitHeight(view);
      });
    }));
    var joints = document.createElement("span");
    joints.className = "joints";
    joints.setAttribute("role", "group");
    joints.setAttribute("aria-label", "Joints");
    data.joints.forEach(function (name, joint) {
      var item = button(name, true, function () { showJoint(joint, item.getAttribute("aria-pressed") !== "true"); });
      item.setAttribute("data-joint-button", String(joint));
      joints.appendChild(item);
    });
    if (data.joints.length > 1 && group.charts[0].joint !== null) bar.appendChild(joints);
    group.figure.insertBefore(bar, group.figure.firstChild);
  }

  function showJoint(joint, on) {
    document.querySelectorAll('[data-joint-button="' + joint + '"]').forEach(function (item) {
      item.setAttribute("aria-pressed", String(on));
    });
    document.querySelectorAll('.panel[data-joint="' + joint + '"]').forEach(function (panel) {
      panel.classList.toggle("off", !on);
    });
  }

  function makeLegend(group) {
    group.figure.querySelectorAll(".legend [data-trace]").forEach(function (item) {
      var names = item.getAttribute("data-trace").split(",");
      item.setAttribute("role", "button");
      item.setAttribute("tabindex", "0");
      item.setAttribute("aria-pressed", "true");
      var act = function () {
        var on = item.getAttribute("aria-pressed") !== "true";
        item.setAttribute("aria-pressed", String(on));
        names.forEach(function (name) { hiddenTraces[traceKey(group.name, name)] = !on; });
        group.views.forEach(function (view) {
          view.lines.forEach(function (line) {
            if (names.indexOf(line.trace.name) >= 0) line.glyph.visible = on;
          });
          fitHeight(view);
        });
      };
      item.addEventListener("click", act);
      item.addEventListener("keydown", function (event) {
        if (event.key === "Enter" || event.key === " ") { event.preventDefault(); act(); }
      });
    });
  }

  function draw(group) {
    if (group.built || !group.figure) return;
    group.built = true;
    addControls(group);
    makeLegend(group);
    group.charts.forEach(function (chart) {
      var panel = group.figure.querySelector('.panel[data-chart="' + chart.key + '"]');
      if (!panel) return;
      var place = document.createElement("div");
      place.className = "live";
      place.setAttribute("role", "group");
      place.setAttribute("aria-label", chart.label);
      panel.appendChild(place);
      build(group, chart, place);
    });
    var page = new Bokeh.Document();
    group.roots.forEach(function (root) { page.add_root(root); });
    Bokeh.embed.add_document_standalone(page, group.figure, group.holders).then(function () {
      group.figure.querySelectorAll(".panel:has(.live)").forEach(function (panel) {
        panel.classList.add("interactive");
      });
      group.ready = true;
    });
  }

  /* A figure is built when it is first seen: a hidden one has no width. */
  var groups = [];
  document.querySelectorAll("figure[data-charts]").forEach(function (figure) {
    var name = figure.getAttribute("data-charts");
    if (data.groups[name]) groups.push(new Group(name, data.groups[name], figure));
  });
  function visible(figure) { return figure.offsetParent !== null && figure.offsetWidth > 0; }
  if (window.IntersectionObserver) {
    var watch = new IntersectionObserver(function (entries) {
      entries.forEach(function (entry) {
        if (!entry.isIntersecting) return;
        watch.unobserve(entry.target);
        groups.forEach(function (group) { if (group.figure === entry.target) draw(group); });
      });
    }, { rootMargin: "600px" });
    groups.forEach(function (group) { watch.observe(group.figure); });
  } else groups.forEach(function (group) { if (visible(group.figure)) draw(group); });

  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", function () {
    groups.forEach(function (group) { group.views.forEach(style); });
  });
  window.hilCharts = groups;
})();
