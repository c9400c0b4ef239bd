// As main.js, with parts that can be pulled.

publish(startPage((report) => embeddedScene(Number(element("view").dataset.parts), report), posable));
