// Wires the page: what is touched changes the state, and the state is drawn.

async function start() {
  const report = readDocument();
  const state = newState(report);
  showHeader(report);
  showFacts(report);
  if (report.map) report.values = await unpackMaps(report.map);
  report.extent = extentOf(report);
  const canvas = byId("map");
  const slider = byId("slider");
  const box = byId("cell");
  let view = null;
  let waiting = false;

  const shown = () => Object.fromEntries(
    ["track", "rays", "objects"].map((name) => [name, byId(`show-${name}`).checked]));
  const lines = buildTable(report, (index) => change({ object: index }));

  function render() {
    waiting = false;
    slider.value = String(state.step);
    describeMoment(report, state);
    fillTable(lines, report, state);
    describeObject(report, state);
    view = drawMap(canvas, report, state, shown());
    box.hidden = !state.cell;
    if (state.cell) {
      describeCell(box, report, state);
      placeCellBox(box, report, view, state.cell);
    }
  }

  function change(changes) {
    Object.assign(state, changes);
    if (!waiting) requestAnimationFrame(render);
    waiting = true;
  }

  function stop() {
    clearInterval(state.playing);
    state.playing = 0;
    byId("play").textContent = "Play";
    byId("play").setAttribute("aria-pressed", "false");
  }

  function play() {
    const last = Number(slider.max);
    if (state.playing) return stop();
    if (state.step === last) change({ step: 0 });
    byId("play").textContent = "Pause";
    byId("play").setAttribute("aria-pressed", "true");
    const pause = Math.min(Math.max(15000 / (last + 1), 40), 800);
    state.playing = setInterval(() => {
      if (state.step < last) change({ step: state.step + 1 });
      if (state.step >= last) stop();
    }, pause);
  }

  slider.max = String(Math.max(report.steps.seconds.length - 1, 0));
  slider.disabled = byId("play").disabled = report.steps.seconds.length < 2;
  slider.addEventListener("input", () => {
    stop();
    change({ step: Number(slider.value) });
  });
  byId("play").addEventListener("click", play);
  fillLayers(report);
  byId("layer").addEventListener("change", (event) => {
    change({ layer: event.target.value });
    showLegend(report, event.target.value);
  });
  for (const name of ["track", "rays", "objects"]) byId(`show-${name}`).addEventListener("change", () => change({}));

  canvas.addEventListener("pointermove", (event) => {
    const place = canvas.getBoundingClientRect();
    change({ cell: cellAt(report, view, event.clientX - place.left, event.clientY - place.top) });
  });
  canvas.addEventListener("pointerdown", (event) => {
    const place = canvas.getBoundingClientRect();
    change({ cell: cellAt(report, view, event.clientX - place.left, event.clientY - place.top) });
  });
  canvas.addEventListener("pointerleave", (event) => {
    // A finger that is lifted leaves what it pointed at.
    if (event.pointerType === "mouse") change({ cell: null });
  });
  canvas.addEventListener("keydown", (event) => {
    const cell = movedCell(report, state, event);
    if (cell === undefined) return;
    event.preventDefault();
    change({ cell });
  });

  const redraw = () => {
    report.image = null;
    showLegend(report, state.layer);
    change({});
  };
  new ResizeObserver(() => change({})).observe(byId("map-box"));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  // Paper is white whatever the screen is.
  for (const [name, printing] of [["beforeprint", true], ["afterprint", false]]) {
    addEventListener(name, () => {
      document.documentElement.classList.toggle("print", printing);
      for (const details of document.querySelectorAll("details")) details.open = printing;
      redraw();
      render();
    });
  }
  showLegend(report, state.layer);
  render();
  document.documentElement.dataset.ready = "true";
}

// The cell that a key leads to, null for none; undefined when the key means nothing here.
function movedCell(report, state, event) {
  if (event.key === "Escape") return null;
  const moves = { ArrowLeft: [0, -1], ArrowRight: [0, 1], ArrowUp: [1, 0], ArrowDown: [-1, 0] };
  const move = moves[event.key];
  if (!move || !report.map) return undefined;
  const { rows, columns } = report.map;
  if (!state.cell) return startCell(report, state);
  const far = event.shiftKey ? 10 : 1;
  const limited = (value, count) => Math.min(Math.max(value, 0), count - 1);
  return {
    row: limited(state.cell.row + far * move[0], rows),
    column: limited(state.cell.column + far * move[1], columns),
  };
}

// Where the keys begin: at the picked object, or in the middle.
function startCell(report, state) {
  const { origin, cell_size: size, rows, columns } = report.map;
  const update = report.objects[state.object] && updateAt(report.objects[state.object], state.step);
  if (update) {
    const row = Math.floor((update.place[1] - origin[1]) / size);
    const column = Math.floor((update.place[0] - origin[0]) / size);
    if (row >= 0 && row < rows && column >= 0 && column < columns) return { row, column };
  }
  return { row: rows >> 1, column: columns >> 1 };
}

function describeMoment(report, state) {
  const { steps } = report;
  const text = [];
  if (steps.seconds.length) {
    const owner = report.objects[steps.object[state.step]];
    const labels = steps.label_sets[steps.labels[state.step]];
    const number = `${steps.numbers[state.step].toLocaleString("en")} of ${countText(steps.total, "measurement")}`;
    text.push(element("b", {}, `t = ${secondsText(steps.seconds[state.step])}`), `  ·  ${number}  ·  `);
    text.push(...(owner ? [nameElement(owner.name), ": "] : []), labels || "no label");
  } else {
    text.push("No measurement.");
  }
  byId("moment").replaceChildren(...text);
  byId("slider").setAttribute("aria-valuetext", byId("moment").textContent);
  byId("map-time").textContent = mapSentence(report, state.step);
  byId("map-time").classList.toggle("later", Boolean(report.map) && mapAt(report, state.step).later);
}

function fillLayers(report) {
  const names = [report.background, ...report.classes.map(({ name }) => name)];
  byId("layer").append(
    element("option", { value: "best" }, "most probable class"),
    ...names.map((name, index) => element("option", { value: String(index) }, `P(${name})`)),
  );
}

function showLegend(report, layer) {
  const colors = themeColors();
  const entries = [];
  const names = [report.background, ...report.classes.map(({ name }) => name)];
  if (layer === "best") {
    names.forEach((name, index) => {
      if (index > CROWD) return;
      const color = index ? report.classes[index - 1].color : mixed(colors.zero, colors.empty, FAINT);
      entries.push(element("span", {}, swatch(color), nameElement(shortened(name, 30))));
    });
    const hidden = names.length - 1 - CROWD;
    if (hidden > 0) entries.push(element("span", { class: "faint" }, `and ${hidden} more, in the same colours again`));
    entries.push(element("span", { class: "faint" }, "the fainter, the less probable"));
  } else {
    const bar = element("canvas", { width: "120", height: "12", role: "img", "aria-label": "colour scale" });
    const pen = bar.getContext("2d");
    for (let x = 0; x < 120; x++) {
      pen.fillStyle = mixed(colors.zero, classColor(report, Number(layer), colors), x / 119);
      pen.fillRect(x, 0, 1, 12);
    }
    pen.strokeStyle = colors.soft;
    pen.strokeRect(0.5, 0.5, 119, 11);
    entries.push(element("span", {}, `P(${shortened(names[Number(layer)], 30)})  0`, bar, "1"));
  }
  const unseen = element("canvas", { width: "22", height: "12", "aria-hidden": "true" });
  hatch(unseen.getContext("2d"), 22, 12, colors);
  entries.push(element("span", {}, unseen, "not seen: the prior"));
  for (const [glyph, text] of glyphs(report, colors)) entries.push(element("span", {}, glyph, text));
  byId("legend").replaceChildren(...entries);
}

// What the lines on the map look like, and what they are.
function glyphs(report, colors) {
  const glyph = (...parts) =>
    drawing("svg", { width: "26", height: "14", viewBox: "0 0 26 14", fill: "none", stroke: "currentColor", "aria-hidden": "true" }, ...parts);
  const path = (d, attributes = {}) => drawing("path", { d, ...attributes });
  const filled = { fill: colors.accent, stroke: "none" };
  return [
    [glyph(path("M1 11C8 1 16 13 25 4", { "stroke-width": "1.8" })), `track of ${report.track.name}`],
    [glyph(path("M22 7L6 1L10 7L6 13Z", filled)), "sensor"],
    [glyph(path("M2 7L24 1V13Z", { ...filled, opacity: "0.35" }), path("M2 7L24 1M2 7L24 13", { stroke: colors.accent })), "detection at this moment"],
    [glyph(path("M1 10L25 3", { opacity: "0.5", "stroke-width": "0.8" })), "detections before"],
    [glyph(drawing("ellipse", { cx: "13", cy: "7", rx: "11", ry: "6" })), "object, 2 standard deviations"],
    [glyph(path("M1 7H18", { "stroke-width": "2" }), path("M25 7L16 3V11Z", { fill: "currentColor", stroke: "none" })), "it may face there; faint: less probable"],
  ];
}

function mixed(from, to, share) {
  const [a, b] = [channels(from), channels(to)];
  return `rgb(${a.map((value, index) => Math.round(value + (b[index] - value) * share)).join(" ")})`;
}

start().catch((error) => {
  byId("failure").hidden = false;
  byId("failure").textContent = `This report cannot be shown: ${error.message}`;
  throw error;
});
