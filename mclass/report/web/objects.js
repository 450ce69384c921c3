// The table of objects, and one of them in detail, at the slider's moment.

function buildTable(report, pick) {
  const body = document.querySelector("#objects tbody");
  report.objects.forEach((object, index) => {
    const button = element("button", { type: "button" }, nameElement(object.name));
    const row = element("tr", {}, element("td", { class: nameClass(object.name) }, button));
    row.addEventListener("click", () => pick(index));
    body.append(row);
  });
  if (!report.objects.length) {
    body.append(element("tr", {}, element("td", { colspan: "5" }, "No objects: no measurement that was used carries an object id.")));
  }
  return [...body.rows].map((row) => ({ row, update: undefined }));
}

// Short names stay on one line.
function nameClass(name) {
  return name.length > 20 ? "name long" : "name";
}

// Only rows whose object changed are written anew.
function fillTable(lines, report, state) {
  report.objects.forEach((object, index) => {
    const line = lines[index];
    const update = updateAt(object, state.step);
    line.row.classList.toggle("picked", index === state.object);
    line.row.querySelector("button").setAttribute("aria-pressed", String(index === state.object));
    if (line.update === update) return;
    line.update = update;
    while (line.row.cells.length > 1) line.row.deleteCell(1);
    line.row.append(...(update ? updateCells(report, update) : [element("td", { colspan: "4", class: "faint" }, "not seen yet")]));
  });
}

function updateCells(report, update) {
  const named = report.classes[update.class];
  const p = update.p[update.class + 1];
  const remarks = [];
  if (update.tie.length) {
    const others = update.tie.map((index) => report.classes[index].name).join(" = ");
    remarks.push(element("div", { class: "remark" }, `a tie: ${others}`));
  }
  if (update.p[0] > p) {
    remarks.push(element("div", { class: "remark" }, `${report.background} is more probable: ${probabilityText(update.p[0])}`));
  }
  const [x, y, spreadX, spreadY] = update.place;
  const shown = update.modes.filter(([, mass], index) => index < 4 && (mass >= 0.001 || index === 0));
  const modes = shown.map((mode) => element("div", {}, modeText(mode)));
  const hidden = update.modes.length - shown.length;
  if (hidden) modes.push(element("div", { class: "faint" }, `+ ${hidden} more`));
  return [
    element("td", { class: nameClass(named.name) }, swatch(named.color), nameElement(named.name), element("div", {}, probabilityText(p)), ...remarks),
    element("td", { "data-label": "position [m]" }, element("div", {}, `x ${spreadText(x, spreadX, 2)}`), element("div", {}, `y ${spreadText(y, spreadY, 2)}`)),
    element("td", { "data-label": "orientation [°]" }, ...(modes.length ? modes : ["any"])),
    element("td", { class: "number", "data-label": "measurements" }, String(update.n)),
  ];
}

function describeObject(report, state) {
  const object = report.objects[state.object];
  byId("object").hidden = !object;
  if (!object) return;
  const update = updateAt(object, state.step);
  byId("object-title").replaceChildren("Object ", nameElement(object.name));
  const all = countText(object.measurements, "measurement");
  const sofar = update ? `after ${update.n} of its ${all}` : `before the first of its ${all}`;
  byId("object-remark").textContent = sofar;
  byId("course").replaceChildren(courseChart(report, object, state.step));
  byId("orientation").parentElement.hidden = !update;
  byId("classes").replaceChildren(...(update ? [classBars(report, update)] : []));
  if (!update) return;
  const { svg, final } = orientationChart(report, object, update);
  byId("orientation").replaceChildren(svg);
  byId("orientation-note").textContent = final
    ? "P(class) · p(orientation | class) for each class, wherever the object stands; dashed uprights are the modes of the named class."
    : "Of the named class, drawn from the stored modes (angle, deviation, share): densities of all classes are stored for the end alone.";
}

function classBars(report, update) {
  const order = [...update.p.keys()].sort((a, b) => update.p[b] - update.p[a] || a - b).slice(0, 8);
  const rows = order.map((index) => {
    const entry = report.classes[index - 1];
    const name = entry ? entry.name : report.background;
    const color = entry ? entry.color : "var(--empty)";
    const bar = drawing("rect", { x: "0", y: "0", height: "12", width: `${100 * update.p[index]}%` });
    bar.style.fill = color;
    const ground = drawing("rect", { x: "0", y: "0", height: "12", width: "100%", class: "ground" });
    return element(
      "tr",
      { "data-class": name },
      element("th", { scope: "row" }, lineSample(index, color), nameElement(name)),
      element("td", { class: "bar" }, drawing("svg", { "aria-hidden": "true" }, ground, bar)),
      element("td", { class: "number" }, probabilityText(update.p[index])),
    );
  });
  const hidden = update.p.length - order.length;
  const table = element("table", {}, element("tbody", {}, ...rows));
  if (hidden) table.append(element("caption", { class: "faint" }, `and ${hidden} less probable`));
  return table;
}
