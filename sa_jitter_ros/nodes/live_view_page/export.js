// The contents of charts as files: CSV of the numbers, PNG of the picture as it is shown.

const SCALE = 2;  // pixels of a picture over those of the page
const DRAWN_BY = ['fill', 'fill-opacity', 'stroke', 'stroke-width', 'stroke-dasharray',
                  'stroke-linejoin', 'image-rendering', 'opacity', 'visibility', 'font-size',
                  'font-family'];

// Lines of a table {columns: [text], rows: [[value]]}; an unknown value is an empty field.
export function csv({columns, rows}) {
  const field = value => {
    const text = value === null || value === undefined ? '' : String(value);
    return /[",\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
  };
  return [columns, ...rows].map(row => `${row.map(field).join(',')}\n`).join('');
}

function save(blob, name) {
  const link = document.createElement('a');
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}

// A copy of a picture that needs no style sheet, without the pixels in it, which come after it.
function standalone(svg) {
  const copy = svg.cloneNode(true), targets = copy.querySelectorAll('*');
  svg.querySelectorAll('*').forEach((node, i) => {
    const style = getComputedStyle(node);
    for (const key of DRAWN_BY) targets[i].setAttribute(key, style.getPropertyValue(key));
  });
  copy.querySelectorAll('image').forEach(node => node.remove());
  copy.setAttribute('width', svg.clientWidth);
  return new Blob([new XMLSerializer().serializeToString(copy)], {type: 'image/svg+xml'});
}

// The pictures, one below the other, as a PNG.
export async function png(svgs, name, background) {
  const heights = svgs.map(svg => svg.clientHeight);
  const canvas = document.createElement('canvas');
  canvas.width = SCALE * Math.max(...svgs.map(svg => svg.clientWidth));
  canvas.height = SCALE * heights.reduce((sum, height) => sum + height, 0);
  const context = canvas.getContext('2d');
  context.fillStyle = background;
  context.fillRect(0, 0, canvas.width, canvas.height);
  context.scale(SCALE, SCALE);
  let top = 0;
  context.imageSmoothingEnabled = false;
  const draw = async (address, ...place) => {
    const image = new Image();
    image.src = address;
    await image.decode();
    context.drawImage(image, ...place);
  };
  for (const [i, svg] of svgs.entries()) {
    const url = URL.createObjectURL(standalone(svg));
    await draw(url, 0, top, svg.clientWidth, heights[i]);
    URL.revokeObjectURL(url);
    for (const node of svg.querySelectorAll('image')) {
      const [x, y, width, height] = ['x', 'y', 'width', 'height'].map(
        key => Number(node.getAttribute(key)));
      await draw(node.getAttribute('href'), x, top + y, width, height);
    }
    top += heights[i];
  }
  canvas.toBlob(blob => save(blob, name), 'image/png');
}

// Buttons that save what a panel shows: `table()` and the pictures in `box`, where it has some;
// `name()` of the file.
export function addButtons(box, table, name, {pictures = true} = {}) {
  const bar = document.createElement('p');
  bar.className = 'save';
  const button = (text, action) => {
    const node = bar.appendChild(document.createElement('button'));
    node.type = 'button';
    node.textContent = text;
    node.title = `save as ${text}`;
    node.onclick = action;
  };
  button('CSV', () => {
    const content = table();
    if (content) save(new Blob([csv(content)], {type: 'text/csv'}), `${name()}.csv`);
  });
  if (pictures) button('PNG', () => {
    const svgs = [...box.querySelectorAll('svg')];
    const card = getComputedStyle(box.closest('section')).backgroundColor;
    if (svgs.length) png(svgs, `${name()}.png`, card);
  });
  box.before(bar);
}
