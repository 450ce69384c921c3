// What the results rest on: what was used and skipped, notes, model, versions.

function tableOf(pairs, numeric) {
  const rows = pairs.map(([name, value]) =>
    element("tr", {}, ...(numeric
      ? [element("td", { class: "number" }, String(value)), element("td", {}, name)]
      : [element("th", { scope: "row" }, name), element("td", {}, value)])));
  return element("table", {}, element("tbody", {}, ...rows));
}

function block(title, ...children) {
  return element("div", {}, element("h3", {}, title), ...children);
}

function listOf(sentences) {
  return element("ul", {}, ...sentences.map((text) => element("li", {}, text)));
}

function showFacts(report) {
  const { facts, steps } = report;
  const blocks = [];
  const used = facts.used === null
    ? element("p", {}, `${countText(steps.total, "measurement")}; how many were used was not recorded.`)
    : tableOf([["used", facts.used.toLocaleString("en")], ...facts.skipped.map(([why, count]) => [`skipped: ${why}`, count.toLocaleString("en")])], true);
  const nothing = facts.used !== null && !facts.skipped.length ? [element("p", { class: "faint" }, "None was skipped.")] : [];
  blocks.push(block("Measurements", used, ...nothing));
  if (steps.numbers.length < steps.total) {
    blocks.push(block("Slider", element("p", {}, `It stops at ${countText(steps.numbers.length, "measurement")} of ${steps.total.toLocaleString("en")}, evenly chosen.`)));
  }
  if (facts.damage.length) blocks.push(block("Damage", listOf(facts.damage)));
  blocks.push(block("Notes", facts.notes.length ? listOf(facts.notes) : element("p", { class: "faint" }, "None.")));
  const versions = [["mclass", facts.version], ["written as", facts.encoding], ["frame", report.frame], ["model", facts.model_name]];
  const hashes = facts.hashes.map(([name, hash]) => [`${name} hash`, element("code", {}, hash)]);
  const settings = facts.settings.map(([name, value]) => [`setting ${name}`, value]);
  blocks.push(block("Versions and settings", tableOf([...versions, ...settings, ...hashes].filter(([, value]) => value))));
  if (facts.model_text) {
    const text = element("pre", { tabindex: "0" }, element("code", {}, facts.model_text));
    const model = element("details", {}, element("summary", {}, "Model file ", nameElement(facts.model_name)), text);
    blocks.push(element("div", { class: "wide" }, model));
  }
  byId("facts-body").replaceChildren(...blocks);
}

function showHeader(report) {
  const { facts, steps } = report;
  document.title = `${report.file} – mclass report`;
  byId("file").replaceChildren(nameElement(report.file));
  const skipped = facts.skipped.reduce((sum, [, count]) => sum + count, 0);
  const counts = facts.used === null
    ? countText(steps.total, "measurement")
    : `${countText(facts.used, "measurement")} used, ${skipped.toLocaleString("en")} skipped`;
  const parts = [countText(report.objects.length, "object"), counts];
  if (steps.total) parts.push(`from ${report.start}, ${secondsText(steps.seconds[steps.seconds.length - 1])} long`);
  parts.push(`model ${facts.model_name}`, `frame ${report.frame}`);
  byId("summary").textContent = parts.join("  ·  ");
  byId("damage").hidden = !facts.damage.length;
  byId("damage").textContent = `Damaged: ${facts.damage.join("; ")}`;
}
