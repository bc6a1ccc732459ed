// The page as the server of `tools/salient view` serves it.

import { startPage } from "./app.js";
import { LiveSource } from "./live.js";

const address = new URL("frames", location.href);
address.protocol = "ws:";
address.search = location.search;
startPage(new LiveSource(address.href));
