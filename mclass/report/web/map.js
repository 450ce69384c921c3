// The map: cells, track, detections and objects as they were at the slider's moment.

const ARROW = 34;
const CROWD = 12;
const FAINT = 0.35;

function themeColors() {
  const style = getComputedStyle(document.documentElement);
  const names = ["ink", "soft", "line", "accent", "zero", "unseen", "halo", "empty", "card"];
  return Object.fromEntries(names.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
}

function channels(color) {
  const full = color.length === 4 ? color.replace(/[0-9a-f]/gi, "$&$&") : color;
  return [1, 3, 5].map((at) => parseInt(full.slice(at, at + 2), 16));
}

function classColor(report, index, colors) {
  return index === 0 ? colors.empty : report.classes[index - 1].color;
}

// The colours of one map's cells as an image of a pixel a cell, row 0 at the bottom.
function cellImage(report, cut, layer, colors) {
  const { map, values, classes } = report;
  const { rows, columns, scale } = map;
  const cells = rows * columns;
  const count = classes.length + 1;
  const first = cut * 2 * count * cells;
  const image = new ImageData(columns, rows);
  const zero = channels(colors.zero);
  const palette = [...Array(count).keys()].map((i) => channels(classColor(report, i, colors)));
  for (let cell = 0; cell < cells; cell++) {
    let shown = layer === "best" ? 0 : Number(layer);
    if (layer === "best") {
      for (let i = 1; i < count; i++) {
        if (values[first + i * cells + cell] > values[first + shown * cells + cell]) shown = i;
      }
    }
    const value = values[first + shown * cells + cell];
    // What is not seen stays clear.
    if (value === NOTHING) continue;
    const color = palette[shown];
    // The background is what is there when nothing is: it steps back.
    const share = (value / scale) * (layer === "best" && shown === 0 ? FAINT : 1);
    const row = rows - 1 - Math.floor(cell / columns);
    const at = 4 * (row * columns + (cell % columns));
    for (let i = 0; i < 3; i++) image.data[at + i] = zero[i] + (color[i] - zero[i]) * share;
    image.data[at + 3] = 255;
  }
  const canvas = new OffscreenCanvas(columns, rows);
  canvas.getContext("2d").putImageData(image, 0, 0);
  return canvas;
}

function drawMap(canvas, report, state, shown) {
  const colors = themeColors();
  const view = viewOf(report.extent, canvas.parentElement.clientWidth);
  const ratio = window.devicePixelRatio || 1;
  canvas.width = Math.round(view.width * ratio);
  canvas.height = Math.round(view.height * ratio);
  canvas.style.aspectRatio = `${view.width} / ${view.height}`;
  const pen = canvas.getContext("2d");
  pen.scale(ratio, ratio);
  pen.save();
  pen.beginPath();
  pen.rect(view.plot.left, view.plot.top, view.plot.width, view.plot.height);
  pen.clip();
  hatch(pen, view.width, view.height, colors);
  if (report.map) drawCells(pen, view, report, state, colors);
  if (shown.rays) drawRays(pen, view, report, state, colors);
  if (shown.track) drawTrack(pen, view, report, state, colors);
  if (shown.objects) drawObjects(pen, view, report, state, colors);
  if (state.cell) drawCursor(pen, view, report, state.cell, colors);
  pen.restore();
  drawAxes(pen, view, colors);
  return view;
}

// The ground of what no measurement has seen.
function hatch(pen, width, height, colors) {
  pen.fillStyle = colors.card;
  pen.fillRect(0, 0, width, height);
  pen.strokeStyle = colors.unseen;
  pen.lineWidth = 2;
  pen.beginPath();
  for (let x = -height; x < width; x += 7) {
    pen.moveTo(x, height);
    pen.lineTo(x + height, 0);
  }
  pen.stroke();
}

function drawCells(pen, view, report, state, colors) {
  const { cut } = mapAt(report, state.step);
  const key = [cut, state.layer, colors.zero].join();
  if (report.image?.key !== key) {
    report.image = { key, canvas: cellImage(report, cut, state.layer, colors) };
  }
  const { origin, cell_size: size, rows, columns } = report.map;
  const left = view.x(origin[0]);
  const bottom = view.y(origin[1]);
  const high = rows * size * view.scale;
  pen.imageSmoothingEnabled = false;
  pen.drawImage(report.image.canvas, left, bottom - high, columns * size * view.scale, high);
}

function drawRays(pen, view, report, state, colors) {
  const { steps, range } = report;
  if (!steps.seconds.length) return;
  const length = range * view.scale;
  pen.strokeStyle = colors.ink;
  pen.lineWidth = 0.7;
  pen.globalAlpha = Math.min(Math.max(15 / (state.step + 1), 0.12), 0.5);
  pen.beginPath();
  for (let step = 0; step <= state.step; step++) {
    if (steps.right[step] === null) continue;
    const angle = steps.right[step] + steps.width[step] / 2;
    const x = view.x(steps.x[step]);
    const y = view.y(steps.y[step]);
    pen.moveTo(x, y);
    pen.lineTo(x + length * Math.cos(angle), y - length * Math.sin(angle));
  }
  pen.stroke();
  const now = state.step;
  if (steps.right[now] !== null) {
    // The one at this moment as it is on the ground: the cone of its box.
    const [right, left] = [steps.right[now], steps.right[now] + steps.width[now]];
    const [x, y] = [view.x(steps.x[now]), view.y(steps.y[now])];
    pen.beginPath();
    pen.moveTo(x, y);
    pen.arc(x, y, length, -right, -left, true);
    pen.closePath();
    pen.globalAlpha = 0.18;
    pen.fillStyle = colors.accent;
    pen.fill();
    pen.globalAlpha = 1;
    pen.strokeStyle = colors.accent;
    pen.lineWidth = 1.5;
    pen.stroke();
  }
  pen.globalAlpha = 1;
}

function drawTrack(pen, view, report, state, colors) {
  const { track, steps } = report;
  const now = timeOf(report, state.step);
  const path = (until) => {
    pen.beginPath();
    track.x.forEach((x, index) => {
      if (track.seconds[index] <= until) pen.lineTo(view.x(x), view.y(track.y[index]));
    });
  };
  pen.lineJoin = "round";
  pen.strokeStyle = colors.ink;
  pen.globalAlpha = 0.3;
  pen.lineWidth = 1;
  pen.setLineDash([2, 3]);
  path(Infinity);
  pen.stroke();
  pen.setLineDash([]);
  pen.globalAlpha = 1;
  for (const [color, width] of [[colors.halo, 4], [colors.ink, 1.8]]) {
    pen.strokeStyle = color;
    pen.lineWidth = width;
    path(now);
    pen.stroke();
  }
  if (!steps.seconds.length) return;
  // The sensor: a dart that points where it looks.
  pen.save();
  pen.translate(view.x(steps.x[state.step]), view.y(steps.y[state.step]));
  pen.rotate(-steps.heading[state.step]);
  pen.beginPath();
  for (const [x, y] of [[11, 0], [-7, 7], [-3, 0], [-7, -7]]) pen.lineTo(x, y);
  pen.closePath();
  pen.fillStyle = colors.accent;
  pen.strokeStyle = colors.halo;
  pen.lineWidth = 3;
  pen.stroke();
  pen.fill();
  pen.restore();
}

function drawObjects(pen, view, report, state, colors) {
  const taken = [];
  const size = Math.min(1, Math.sqrt(CROWD / Math.max(report.objects.length, 1)));
  const order = [...report.objects.keys()].filter((index) => index !== state.object);
  for (const index of [...order, state.object]) {
    const object = report.objects[index];
    const update = object && updateAt(object, state.step);
    if (!update) continue;
    const [x, y, spreadX, spreadY] = update.place;
    const at = { x: view.x(x), y: view.y(y) };
    const picked = index === state.object;
    pen.beginPath();
    pen.ellipse(at.x, at.y, 2 * spreadX * view.scale, 2 * spreadY * view.scale, 0, 0, 2 * Math.PI);
    outlined(pen, colors, 1.2);
    for (const [angle, mass] of update.modes) {
      // The root, as one of many directions would hardly be seen.
      pen.globalAlpha = Math.min(Math.max(Math.sqrt(mass), 0.15), 1);
      drawArrow(pen, at, (angle * Math.PI) / 180, ARROW * size, colors);
    }
    pen.globalAlpha = 1;
    pen.beginPath();
    pen.arc(at.x, at.y, (picked ? 7 : 5.5) * Math.max(size, 0.6), 0, 2 * Math.PI);
    pen.fillStyle = report.classes[update.class].color;
    pen.fill();
    outlined(pen, colors, picked ? 2.5 : 1.5);
    drawName(pen, view, report, object, update, at, taken, colors, picked);
  }
}

function outlined(pen, colors, width) {
  pen.strokeStyle = colors.halo;
  pen.lineWidth = width + 2;
  pen.stroke();
  pen.strokeStyle = colors.ink;
  pen.lineWidth = width;
  pen.stroke();
}

function drawArrow(pen, at, angle, length, colors) {
  pen.save();
  pen.translate(at.x, at.y);
  pen.rotate(-angle);
  pen.beginPath();
  pen.moveTo(0, 0);
  pen.lineTo(length - 6, 0);
  outlined(pen, colors, 2);
  pen.beginPath();
  pen.moveTo(length, 0);
  pen.lineTo(length - 10, 5);
  pen.lineTo(length - 10, -5);
  pen.closePath();
  pen.fillStyle = colors.ink;
  pen.strokeStyle = colors.halo;
  pen.lineWidth = 1.5;
  pen.stroke();
  pen.fill();
  pen.restore();
}

// The object's name at the first corner where it hides neither arrows nor other names.
function drawName(pen, view, report, object, update, at, taken, colors, picked) {
  pen.font = `${picked ? "600 " : ""}12px system-ui, sans-serif`;
  pen.textBaseline = "middle";
  const name = shortened(object.name, 24);
  const found = report.objects.length > CROWD ? "" : shortened(report.classes[update.class].name, 20);
  const lines = found ? [name, `${found} ${update.p[update.class + 1].toFixed(2)}`] : [name];
  const width = Math.max(...lines.map((text) => pen.measureText(text).width));
  const height = 15 * lines.length;
  const boxes = [[1, -1], [1, 1], [-1, -1], [-1, 1]].map(([right, down]) => ({
    right,
    left: right > 0 ? at.x + 10 : at.x - 10 - width,
    top: down > 0 ? at.y + 7 : at.y - 7 - height,
    cost: update.modes.reduce((sum, [angle, mass]) => {
      const turn = (angle * Math.PI) / 180;
      return sum + mass * Math.max(0, Math.cos(turn) * right * 0.8 - Math.sin(turn) * down * 0.6);
    }, 0),
  }));
  const { plot } = view;
  for (const box of boxes) {
    box.bottom = box.top + height;
    const over = (other) =>
      box.left < other.left + other.width && other.left < box.left + width &&
      box.top < other.bottom && other.top < box.bottom;
    if (taken.some(over)) box.cost += 3;
    if (box.left < plot.left || box.left + width > plot.left + plot.width) box.cost += 5;
    if (box.top < plot.top || box.bottom > plot.top + plot.height) box.cost += 5;
  }
  const best = boxes.reduce((a, b) => (b.cost < a.cost ? b : a));
  // In a crowd a name that would hide another is left to the table.
  if (best.cost >= 3 && !picked && report.objects.length > CROWD) return;
  taken.push({ left: best.left, top: best.top, bottom: best.bottom, width });
  pen.textAlign = best.right > 0 ? "left" : "right";
  pen.lineJoin = "round";
  lines.forEach((text, index) => {
    const x = best.right > 0 ? best.left : best.left + width;
    const y = best.top + 15 * index + 8;
    pen.strokeStyle = colors.halo;
    pen.lineWidth = 4;
    pen.strokeText(text, x, y);
    pen.fillStyle = colors.ink;
    pen.fillText(text, x, y);
  });
}

function shortened(text, limit) {
  const letters = [...text];
  return letters.length <= limit ? text : `${letters.slice(0, limit - 1).join("")}…`;
}

function drawCursor(pen, view, report, cell, colors) {
  const { origin, cell_size: size } = report.map;
  const side = Math.max(size * view.scale, 4);
  const left = view.x(origin[0] + cell.column * size);
  const top = view.y(origin[1] + (cell.row + 1) * size);
  pen.strokeStyle = colors.halo;
  pen.lineWidth = 4;
  pen.strokeRect(left, top, side, side);
  pen.strokeStyle = colors.accent;
  pen.lineWidth = 2;
  pen.strokeRect(left, top, side, side);
}

// The cell under a point of the canvas; null outside of the cells that were touched.
function cellAt(report, view, x, y) {
  if (!report.map) return null;
  const { origin, cell_size: size, rows, columns } = report.map;
  const row = Math.floor((view.metresY(y) - origin[1]) / size);
  const column = Math.floor((view.metresX(x) - origin[0]) / size);
  return row >= 0 && row < rows && column >= 0 && column < columns ? { row, column } : null;
}

// Fill the readout of a cell.
function describeCell(box, report, state) {
  const { row, column } = state.cell;
  const { map, classes } = report;
  const { cut } = mapAt(report, state.step);
  const belief = cellBelief(report, cut, row, column);
  const [x, y] = [map.origin[0] + (column + 0.5) * map.cell_size, map.origin[1] + (row + 0.5) * map.cell_size];
  const place = `x ${spreadText(x, 0, 2)}, y ${spreadText(y, 0, 2)} m`;
  const number = `row ${row + map.first_row}, column ${column + map.first_column}`;
  const rows = [element("div", {}, element("b", {}, place)), element("div", { class: "faint" }, number)];
  const touched = belief && belief.measurements !== null ? countText(belief.measurements, "measurement") : "";
  rows.push(element("div", { class: "faint" }, belief ? touched : "not seen: the prior"));
  const values = belief ? belief.probabilities : map.prior;
  const order = [...values.keys()].sort((a, b) => values[b] - values[a] || a - b).slice(0, 8);
  const lines = order.map((index) => {
    const name = index ? classes[index - 1].name : report.background;
    const degrees = index && belief ? belief.degrees[index - 1] : null;
    const faces = !index || !belief ? "" : degrees === null ? "any" : `${degrees}°`;
    const p = values[index] === 0 && belief ? "<0.0001" : probabilityText(values[index]);
    return element(
      "tr",
      { "data-class": name },
      element("th", { scope: "row" }, swatch(index ? classes[index - 1].color : "var(--empty)"), nameElement(name)),
      element("td", { class: "number" }, p),
      element("td", { class: "number" }, faces),
    );
  });
  const heads = ["class", "P", "faces"].map((text, index) =>
    element("th", { scope: "col", class: index ? "number" : "" }, text));
  const hidden = values.length - order.length;
  const more = hidden ? [element("div", { class: "faint" }, `and ${hidden} less probable`)] : [];
  box.replaceChildren(
    ...rows,
    element("table", {}, element("thead", {}, element("tr", {}, ...heads)), element("tbody", {}, ...lines)),
    ...more,
  );
}

// Beside the cell, inside of the map's box.
function placeCellBox(box, report, view, cell) {
  const { origin, cell_size: size } = report.map;
  const x = view.x(origin[0] + (cell.column + 0.5) * size);
  const y = view.y(origin[1] + (cell.row + 0.5) * size);
  const gap = 14 + (size * view.scale) / 2;
  const [wide, high] = [box.offsetWidth, box.offsetHeight];
  let left = x + gap + wide <= view.width ? x + gap : x - gap - wide;
  let top = Math.min(Math.max(y - high / 2, 0), view.height - high);
  if (left < 0) {
    // On a narrow page there is room above or below only.
    left = Math.min(Math.max(x - wide / 2, 0), view.width - wide);
    top = y > view.height / 2 ? y - gap - high : y + gap;
  }
  box.style.left = `${left}px`;
  box.style.top = `${top}px`;
}
