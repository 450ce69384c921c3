// How numbers read, the same as in the terminal; and elements that hold text.

function probabilityText(p) {
  if (p === null) return "–";
  if (p === 0 || p >= 0.00005) return p.toFixed(4);
  const [mantissa, exponent] = p.toExponential(1).split("e-");
  return `${mantissa}e-${exponent.padStart(2, "0")}`;
}

function shareText(fraction) {
  const percent = Math.round(100 * fraction);
  if (percent === 0 && fraction > 0) return "<1 %";
  if (percent === 100 && fraction < 0.9995) return ">99 %";
  return `${percent} %`;
}

function degreesText(angle) {
  const text = angle.toFixed(1);
  return text === "360.0" ? "0.0" : text;
}

function spreadText(value, deviation, digits) {
  const text = value.toFixed(digits).replace("-", "−");
  return deviation ? `${text} ± ${deviation.toFixed(digits)}` : text;
}

function modeText([angle, mass, deviation]) {
  const spread = deviation === null ? "" : ` ± ${deviation.toFixed(1)}`;
  return `${degreesText(angle)}${spread} (${shareText(mass)})`;
}

function secondsText(seconds) {
  return `${seconds.toFixed(3).replace("-", "−")} s`;
}

function countText(count, noun) {
  return `${count.toLocaleString("en")} ${noun}${count === 1 ? "" : "s"}`;
}

// An element with attributes and children; strings among them become text, never markup.
function element(tag, attributes = {}, ...children) {
  return filled(document.createElement(tag), attributes, children);
}

function drawing(tag, attributes = {}, ...children) {
  return filled(document.createElementNS("http://www.w3.org/2000/svg", tag), attributes, children);
}

function filled(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  node.append(...children);
  return node;
}

// A foreign name; its direction of writing must not turn its surroundings around.
function nameElement(name, attributes = {}) {
  return element("bdi", { title: name, ...attributes }, name);
}

function swatch(color) {
  const node = element("span", { class: "swatch", "aria-hidden": "true" });
  node.style.background = color;
  return node;
}

function byId(id) {
  return document.getElementById(id);
}
