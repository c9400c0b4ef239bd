// The page as one file, which holds its scene.

publish(startPage((report) => embeddedScene(Number(element("view").dataset.parts), report)));
