// An object's orientation, and its class over time, as drawings.

// Its width is that of the column, so that letters keep their size.
const CHART = { width: 560, height: 180, left: 46, right: 18, top: 20, bottom: 36 };
const DASHES = ["none", "7 3", "7 2 2 2", "2 2"];
const MOST_CURVES = 6;
const MOST_MODES = 4;
const COURSE_TOP = 1.05;

function chart(label) {
  CHART.width = Math.min(Math.max(byId("object").clientWidth, 240), 640);
  return drawing("svg", { viewBox: `0 0 ${CHART.width} ${CHART.height}`, role: "img", "aria-label": label });
}

function chartText(x, y, text, attributes = {}) {
  return drawing("text", { x, y, "text-anchor": "middle", ...attributes }, text);
}

function chartX(share) {
  return CHART.left + share * (CHART.width - CHART.left - CHART.right);
}

function chartY(share) {
  return CHART.height - CHART.bottom - share * (CHART.height - CHART.top - CHART.bottom);
}

function curve(points, place, color) {
  const path = points.map(([x, y], at) => `${at ? "L" : "M"}${x.toFixed(1)} ${y.toFixed(1)}`).join("");
  const line = drawing("path", { d: path, class: "curve", "stroke-dasharray": dashes(place) });
  line.style.stroke = color;
  return line;
}

// How the curves of the background (0) or of a class are drawn.
function dashes(place) {
  return place ? DASHES[(place - 1) % DASHES.length] : "1 3";
}

function lineSample(place, color) {
  const sample = drawing("path", { d: "M0 4H28", class: "curve", "stroke-dasharray": dashes(place) });
  sample.style.stroke = color;
  return drawing("svg", { viewBox: "0 0 28 8", "aria-hidden": "true" }, sample);
}

function frame(svg) {
  const [left, right, low, high] = [chartX(0), chartX(1), chartY(0), chartY(1)];
  svg.append(drawing("path", { class: "axis", d: `M${left} ${high}V${low}H${right}` }));
}

// Densities of the final belief; before it what the modes of the named class say.
function orientationChart(report, object, update) {
  const final = object.density && update.n === object.measurements;
  const shown = [...report.classes.keys()]
    .sort((a, b) => update.p[b + 1] - update.p[a + 1] || a - b)
    .slice(0, MOST_CURVES)
    .sort((a, b) => a - b);
  const curves = [];
  for (const index of shown) {
    const p = update.p[index + 1];
    if (final) {
      const values = object.density.classes[index];
      if (!values.includes(null)) curves.push([index, [...values, values[0]].map((value) => p * value)]);
    } else if (index === update.class) {
      curves.push([index, modeDensity(update.modes).map((value) => p * value)]);
    }
  }
  const peak = Math.max(...curves.flatMap(([, values]) => values), 1e-3) * 1.08;
  const svg = chart("Orientation density: P(class) times p(orientation given class), per radian");
  frame(svg);
  const modes = update.modes.slice(0, MOST_MODES).filter(([, mass]) => mass >= 0.02);
  for (const [angle] of modes) {
    const x = chartX(angle / 360);
    svg.append(drawing("line", { class: "mode", x1: x, x2: x, y1: chartY(0), y2: chartY(1) }));
    const near = modes.some(([other]) => other > angle && other - angle < 30);
    const anchor = angle < 20 ? "start" : angle > 340 || near ? "end" : "middle";
    svg.append(chartText(x, 13, `${degreesText(angle)}°`, { class: "mode-text", "text-anchor": anchor }));
  }
  for (const [index, values] of curves) {
    const last = values.length - 1;
    const points = values.map((value, at) => [chartX(at / last), chartY(value / peak)]);
    svg.append(curve(points, index + 1, report.classes[index].color));
  }
  for (let angle = 0; angle <= 360; angle += CHART.width < 420 ? 90 : 45) {
    const x = chartX(angle / 360);
    svg.append(drawing("path", { class: "axis", d: `M${x} ${chartY(0)}v4` }), chartText(x, chartY(0) + 16, `${angle}°`));
  }
  yLabels(svg, peak, "per radian");
  return { svg, final };
}

function yLabels(svg, peak, unit) {
  const step = roundBelow(peak / 2);
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  for (let value = 0; value <= peak; value += step) {
    const y = chartY(value / peak);
    svg.append(chartText(CHART.left - 6, y + 4, value.toFixed(digits), { "text-anchor": "end" }));
    svg.append(drawing("path", { class: "axis", d: `M${CHART.left - 4} ${y}h4` }));
  }
  const middle = (chartY(0) + chartY(1)) / 2;
  svg.append(chartText(11, middle, unit, { transform: `rotate(-90 11 ${middle})` }));
}

// Wrapped Gaussians of the modes' angles, deviations and masses, at every degree.
function modeDensity(modes) {
  return [...Array(361).keys()].map((degree) =>
    modes.reduce((sum, [angle, mass, deviation]) => {
      if (deviation === null || deviation <= 0) return sum;
      const spread = (deviation * Math.PI) / 180;
      const turns = [-360, 0, 360].map((turn) => (degree - angle + turn) / deviation);
      const total = turns.reduce((part, z) => part + Math.exp(-0.5 * z * z), 0);
      return sum + (mass * total) / (spread * Math.sqrt(2 * Math.PI));
    }, 0));
}

// P(class) after each of the object's measurements; a bar stands at the slider's moment.
function courseChart(report, object, step) {
  const svg = chart("Probability of each class over time");
  const { seconds } = report.steps;
  const end = Math.max(seconds[seconds.length - 1], 1e-3);
  const x = (time) => chartX(time / end);
  frame(svg);
  const last = object.updates[object.updates.length - 1];
  const shown = [...report.classes.keys()]
    .sort((a, b) => last.p[b + 1] - last.p[a + 1] || a - b)
    .slice(0, MOST_CURVES);
  for (const place of [0, ...shown.map((index) => index + 1).sort((a, b) => a - b)]) {
    const points = [];
    object.updates.forEach((update, at) => {
      const next = object.updates[at + 1];
      const y = chartY(update.p[place] / COURSE_TOP);
      points.push([x(seconds[update.step]), y], [next ? x(seconds[next.step]) : x(end), y]);
    });
    svg.append(curve(points, place, place ? report.classes[place - 1].color : "var(--empty)"));
  }
  const now = x(seconds[step]);
  svg.append(drawing("line", { class: "now", x1: now, x2: now, y1: chartY(0), y2: chartY(1) }));
  for (const { value, text } of ticks(0, end, 6)) {
    svg.append(drawing("path", { class: "axis", d: `M${x(value)} ${chartY(0)}v4` }), chartText(x(value), chartY(0) + 16, text));
  }
  svg.append(chartText(chartX(0.5), CHART.height - 3, "seconds since the first measurement"));
  yLabels(svg, COURSE_TOP, "P(class)");
  return svg;
}
