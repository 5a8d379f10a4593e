"use strict";
for (const box of document.querySelectorAll(".compare")) {
  const stage = box.querySelector(".stage");
  const range = box.querySelector("input");
  const images = [...stage.querySelectorAll("img")];
  const sides = [...box.querySelectorAll("select")];
  const show = () => {
    for (const image of images) image.classList.remove("left", "right");
    for (const select of sides) {
      const image = images[select.selectedIndex];
      if (!image.classList.length) image.classList.add(select.dataset.side);
    }
    // The one picture that is on both sides is shown whole.
    if (!stage.querySelector(".right")) stage.querySelector(".left").className = "right";
  };
  const move = (percent) => {
    range.value = percent;
    stage.style.setProperty("--at", range.value + "%");
  };
  const follow = (event) => {
    const frame = stage.getBoundingClientRect();
    move((100 * (event.clientX - frame.left)) / frame.width);
  };
  sides[1].selectedIndex = 1;
  for (const select of sides) select.addEventListener("change", show);
  range.addEventListener("input", () => move(range.value));
  stage.addEventListener("pointerdown", follow);
  stage.addEventListener("pointermove", (event) => event.buttons && follow(event));
  show();
  move(50);
}
