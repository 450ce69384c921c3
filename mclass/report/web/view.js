// From metres to pixels: equal scales, axes with round numbers.

const MARGIN = { left: 52, right: 14, top: 12, bottom: 42 };
const ROOM = 20; // pixels within the axes, for arrows

// Ranges of x and y [m] that hold everything drawn.
function extentOf(report) {
  const xs = [...report.track.x, ...report.steps.x];
  const ys = [...report.track.y, ...report.steps.y];
  for (const object of report.objects) {
    for (const { place } of object.updates.slice(-1)) {
      xs.push(place[0] - 2 * place[2], place[0] + 2 * place[2]);
      ys.push(place[1] - 2 * place[3], place[1] + 2 * place[3]);
    }
  }
  if (report.map) {
    const { origin, cell_size: size, rows, columns } = report.map;
    xs.push(origin[0], origin[0] + columns * size);
    ys.push(origin[1], origin[1] + rows * size);
  }
  const range = (values) => {
    let [low, high] = [Infinity, -Infinity];
    for (const value of values) {
      if (value === null) continue;
      low = Math.min(low, value);
      high = Math.max(high, value);
    }
    if (low > high) [low, high] = [-1, 1];
    const half = Math.max((high - low) / 2, 0.5);
    const middle = (low + high) / 2;
    return [middle - half, middle + half];
  };
  return { x: range(xs), y: range(ys) };
}

// How the plane lies on a canvas of a width: the shorter side shows more than it must.
function viewOf(extent, width) {
  const plotWidth = Math.max(width - MARGIN.left - MARGIN.right, 80);
  const wide = extent.x[1] - extent.x[0];
  const high = extent.y[1] - extent.y[0];
  const [innerWidth, most] = [plotWidth - 2 * ROOM, 680 - 2 * ROOM];
  const innerHeight = Math.min(Math.max((innerWidth * high) / wide, 200), most);
  const plotHeight = innerHeight + 2 * ROOM;
  const scale = Math.min(innerWidth / wide, innerHeight / high);
  const middle = { x: (extent.x[0] + extent.x[1]) / 2, y: (extent.y[0] + extent.y[1]) / 2 };
  const plot = { left: MARGIN.left, top: MARGIN.top, width: plotWidth, height: plotHeight };
  return {
    width,
    height: plotHeight + MARGIN.top + MARGIN.bottom,
    plot,
    scale,
    x: (metres) => plot.left + plotWidth / 2 + (metres - middle.x) * scale,
    y: (metres) => plot.top + plotHeight / 2 - (metres - middle.y) * scale,
    metresX: (pixel) => (pixel - plot.left - plotWidth / 2) / scale + middle.x,
    metresY: (pixel) => (plot.top + plotHeight / 2 - pixel) / scale + middle.y,
  };
}

// The largest of 1, 2, 5 times a power of ten that is not above a number.
function roundBelow(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return power * [5, 2, 1].find((step) => step * power <= value * (1 + 1e-9));
}

function ticks(low, high, wanted) {
  const step = roundBelow(((high - low) / wanted) * 2);
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  const found = [];
  for (let index = Math.ceil(low / step); index * step <= high; index++) {
    found.push({ value: index * step, text: (index * step).toFixed(digits).replace("-", "−") });
  }
  return found;
}

function drawAxes(pen, view, colors) {
  const { plot } = view;
  const right = plot.left + plot.width;
  const bottom = plot.top + plot.height;
  pen.strokeStyle = colors.line;
  pen.fillStyle = colors.soft;
  pen.lineWidth = 1;
  pen.strokeRect(plot.left - 0.5, plot.top - 0.5, plot.width + 1, plot.height + 1);
  pen.font = "12px system-ui, sans-serif";
  pen.textAlign = "center";
  pen.textBaseline = "top";
  for (const { value, text } of ticks(view.metresX(plot.left), view.metresX(right), plot.width / 70)) {
    const x = Math.round(view.x(value)) + 0.5;
    line(pen, x, bottom, x, bottom + 5);
    pen.fillText(text, x, bottom + 7);
  }
  pen.fillText("x [m]", plot.left + plot.width / 2, bottom + 24);
  pen.textAlign = "right";
  pen.textBaseline = "middle";
  for (const { value, text } of ticks(view.metresY(bottom), view.metresY(plot.top), plot.height / 70)) {
    const y = Math.round(view.y(value)) + 0.5;
    line(pen, plot.left - 5, y, plot.left, y);
    pen.fillText(text, plot.left - 8, y);
  }
  pen.save();
  pen.translate(10, plot.top + plot.height / 2);
  pen.rotate(-Math.PI / 2);
  pen.textAlign = "center";
  pen.fillText("y [m]", 0, 0);
  pen.restore();
  drawScaleBar(pen, view, colors);
}

// Below the axes at the right, where it hides nothing.
function drawScaleBar(pen, view, colors) {
  const { plot } = view;
  const metres = roundBelow((0.2 * plot.width) / view.scale);
  const length = metres * view.scale;
  const right = plot.left + plot.width;
  const y = plot.top + plot.height + 31;
  pen.strokeStyle = colors.ink;
  pen.fillStyle = colors.ink;
  pen.lineWidth = 2;
  line(pen, right - length, y, right, y);
  line(pen, right - length, y - 4, right - length, y + 4);
  line(pen, right, y - 4, right, y + 4);
  pen.textAlign = "right";
  pen.textBaseline = "middle";
  pen.fillText(`${metres} m`, right - length - 8, y);
}

function line(pen, x0, y0, x1, y1) {
  pen.beginPath();
  pen.moveTo(x0, y0);
  pen.lineTo(x1, y1);
  pen.stroke();
}
