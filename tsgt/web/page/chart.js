// Residuals of the prisms against their layout, over the last minutes.

const SPAN_S = 300;
const DASHES = [[], [8, 4], [2, 3], [10, 3, 2, 3]];
const STEPS_MM = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000];

export function drawChart(canvas, points, now_s, limit_mm) {
  const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(height * ratio);
  const style = getComputedStyle(document.documentElement);
  const colour = (name) => style.getPropertyValue(`--${name}`).trim();
  const pen = canvas.getContext("2d");
  pen.scale(ratio, ratio);
  pen.font = "600 12px system-ui, sans-serif";
  const left = 46, bottom = height - 18, top = 8;
  const shown = points.filter((point) => point[0] > now_s - SPAN_S);
  const largest = Math.max(5, ...shown.flatMap((point) => Object.values(point[1])));
  const step = STEPS_MM.find((each) => largest / each <= 4) || 5000;
  const high = step * Math.ceil(largest / step);
  const x = (at_s) => left + (width - left - 6) * (1 - (now_s - at_s) / SPAN_S);
  const y = (mm) => bottom - (bottom - top) * mm / high;
  pen.strokeStyle = colour("line");
  pen.fillStyle = colour("front");
  pen.lineWidth = 1;
  for (let mm = 0; mm <= high; mm += step) {
    pen.beginPath(); pen.moveTo(left, y(mm)); pen.lineTo(width - 6, y(mm)); pen.stroke();
    pen.textAlign = "right";
    pen.fillText(mm === high ? `${mm} mm` : String(mm), left - 5, y(mm) + 4);
  }
  pen.textAlign = "center";
  for (const minutes of [4, 3, 2, 1]) pen.fillText(`-${minutes} min`, x(now_s - 60 * minutes), height - 3);
  if (limit_mm && limit_mm <= high) {
    pen.strokeStyle = colour("bad");
    pen.lineWidth = 2;
    pen.beginPath(); pen.moveTo(left, y(limit_mm)); pen.lineTo(width - 6, y(limit_mm)); pen.stroke();
  }
  const prisms = [...new Set(shown.flatMap((point) => Object.keys(point[1])))].sort();
  prisms.forEach((prism) => {
    const index = (Number(prism) - 1) % 4;
    pen.strokeStyle = colour(`p${index + 1}`);
    pen.lineWidth = 2;
    pen.setLineDash(DASHES[index]);
    pen.beginPath();
    let before_s = -Infinity;
    for (const [at_s, values] of shown) {
      if (values[prism] === undefined) continue;
      if (at_s - before_s > 3) pen.moveTo(x(at_s), y(values[prism])); else pen.lineTo(x(at_s), y(values[prism]));
      before_s = at_s;
    }
    pen.stroke();
  });
  pen.setLineDash([]);
  return prisms;
}
