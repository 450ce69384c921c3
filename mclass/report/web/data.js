// The report's document, and its maps unpacked.

const NOTHING = 0xffff;

function readDocument() {
  return JSON.parse(byId("document").textContent);
}

async function unpackMaps(map) {
  if (!("DecompressionStream" in window)) {
    throw new Error("This browser is too old to unpack the maps; one of 2023 or later can.");
  }
  const packed = Uint8Array.from(atob(map.data), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const halves = new Uint8Array(await new Response(stream).arrayBuffer());
  const count = halves.length / 2;
  const values = new Uint16Array(count);
  const size = count / map.seconds.length;
  for (let i = 0; i < count; i++) {
    // Wraps around at 65,536, as the differences did.
    values[i] = (halves[i] | (halves[count + i] << 8)) + (i >= size ? values[i - size] : 0);
  }
  return values;
}

// What one map says of one cell; null where no measurement pointed.
function cellBelief(report, cut, row, column) {
  const { map, values, classes } = report;
  const cells = map.rows * map.columns;
  const planes = 2 * (classes.length + 1);
  const at = (plane) => values[(cut * planes + plane) * cells + row * map.columns + column];
  if (at(0) === NOTHING) return null;
  const known = (value) => (value === NOTHING ? null : value);
  return {
    probabilities: [null, ...classes].map((_, plane) => at(plane) / map.scale),
    degrees: classes.map((_, index) => known(at(classes.length + 1 + index))),
    measurements: known(at(planes - 1)),
  };
}
