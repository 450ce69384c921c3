// What is looked at, and what the report says at that moment.

function newState(report) {
  const last = Math.max(report.steps.seconds.length - 1, 0);
  return { step: last, layer: "best", cell: null, object: 0, playing: 0 };
}

// An object's latest update at a step; null before its first.
function updateAt(object, step) {
  let low = 0;
  let high = object.updates.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (object.updates[middle].step <= step) low = middle + 1;
    else high = middle;
  }
  return low ? object.updates[low - 1] : null;
}

function timeOf(report, step) {
  return report.steps.seconds.length ? report.steps.seconds[step] : 0;
}

// The map shown at a step: the latest one until then; else the first there is, which is later.
function mapAt(report, step) {
  const { seconds } = report.map;
  const now = timeOf(report, step);
  const cut = seconds.findLastIndex((time) => time <= now);
  return cut < 0 ? { cut: 0, later: true } : { cut, later: false };
}

function mapSentence(report, step) {
  if (!report.map) return "The output holds no map.";
  const { cut, later } = mapAt(report, step);
  const { seconds, stored } = report.map;
  const many = seconds.length > 1 ? ` (map ${cut + 1} of ${seconds.length})` : "";
  const parts = [`The map shows the belief at t = ${secondsText(seconds[cut])}${many}.`];
  if (later) parts.push("That is later than the slider: no earlier map is stored.");
  if (stored === 1) parts.push("Only this one is stored; estimate --every SECONDS stores more.");
  if (stored > seconds.length) parts.push(`The output holds ${stored} maps; these are some.`);
  return parts.join(" ");
}
