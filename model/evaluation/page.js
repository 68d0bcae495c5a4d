// SPDX-License-Identifier: MIT
for (const pair of document.querySelectorAll('.pair')) {
  const range = pair.querySelector('input');
  const move = () => pair.style.setProperty('--at', range.value + '%');
  range.addEventListener('input', move);
  pair.addEventListener('pointermove', event => {
    if (event.pointerType !== 'mouse') return;
    const box = pair.getBoundingClientRect();
    range.value = 100 * (event.clientX - box.left) / box.width;
    move();
  });
}
