"""Hashes of the code that a result depends on: modules and their imports from their own package and from bench."""

from __future__ import annotations

import ast
import hashlib
import importlib.machinery
import importlib.util
import sys
from collections.abc import Collection, Iterable, Iterator
from functools import cache
from pathlib import Path

from bench.model.parameters import remember

EQUIVALENT: dict[str, str] = {
    # bench/model/program.py: a scene may name the class of its programs, and the weights of its costs, which are 1 in all stored rows
    "b04d8f5748b7f944c3659eddf5d99cb19406be96f501ffe3379e865a000c4211": "537e21f7c1463cf5e114b297818ea6abf2ec7e5556f8f0da67faa3578015e5ff",
    # bench/model/scene.py: a scene may name the class of its programs, the derivative of its feedback, weights of its costs, an MJCF file, and its events
    "f2fb257863e04aeb9706b8ab770ef996056df0e777d573a558f837b04e7fec18": "19a77ee56a6a214a4dc2c76e08a14257a51fb50b9c3cdad578f647101743edcb",
    # bench/measure/reference.py: noise on the actions beside a scene's own noise, which no stored scene has
    "8e9c1980ecf41fda3cffe337a73bda5f04f968b11b11f7bd78492e9239172a70": "f4ea930fd9b4c514b92e905d9ee99b00899e60ecef16cc4e558020bce228ddd2",
    # bench/model/estimator.py: noise on the actions beside a scene's own noise, which no stored scene has; a declaration for the kit
    "988bb8d1a2f8f54a8859fad7be6e195bdbace1ec4a774247a41132b7ce1076b3": "297f51107543e92425d4da900ff76f5713b7be2f7b41083c98ff121267327fdc",
    # bench/model/problem.py: noise on the actions beside a scene's own noise, which no stored scene has
    "d253d82556790fbfa9c54d8b60474b8450cdff44271a3a8e42ea6788bc5dfb93": "b537cd67e11a1065dce873c040744092aa6c8dbc2af87f4d4b4942d39197585c",
    # bench/model/adjoint.py: uses a scene's own derivative of the feedback and weights of its costs, which no stored scene has, and makes no array that it does not use
    "f289ee60c7db4889658136b05bcfc15e2ac1d357bdb99740c1023fa3843be036": "d6d35bf0003a6041adf76a4e9ccca9ede0b96e1241a58774c8fbf795bedcd942",
    # bench/model/manifold.py: the joints of a scene may depend on its parameters
    "c38492d867e6f03e0243c75cef3741d9cb79210f93ea28080e68b0c514e4eb05": "e8ce151ce4c198a1b8893f9f61339c4ec86bdcf2b79d517068441741c4451491",
    # plugins/mjcf.py: models from files, which no stored scene has; contacts for gradient checks and traces
    "b68d3d6eb6965e70c1e8bfc719ba31805a1b015f5fb9e06ea7e86b84727b837e": "9588c6383692c78b228217c715da2ccb1545a8adcc91db6c170db7531606f85c",
    # plugins/backends/mujoco.py: programs with a policy, which no stored scene has; contacts for gradient checks and traces
    "b392988da4aa3f807e846c0a0cbebc04c3700897b947dcb409b45f3c4da71371": "b1b262672b057e5f7cdafaf36a41d335c4543c3e9956d73e60a0d9ede57e60e2",
    # plugins/backends/mjx.py: programs with a policy and models from files, which no stored scene has; contacts for gradient checks and traces
    "552daf16d16a3031ce2de6a8eb13325db9421a8b3e45f4281e340480a8c8b6f5": "785dd047351f2bee8e0aeb5c2c6d36ef7616c3cb47fd9e7d898f13a91ae57769",
    # plugins/backends/jax.py: its loop is a function that other backends call, and blocks of few columns for a theta longer than in any stored row
    "ffbf774226467927a27ec9e78971b492dcac2e2584208254123440d5d3c69b4a": "a46ed4d792f61433071933b66bd03d3ad33ff491c1585d8568ee77b069d5cb09",
    # plugins/backends/checkpointed.py: calls the loop of jax, and provides surrogate gradients, which no stored row uses
    "5576d15eeb6545cec4296d7010d7d149086dc768d2a57e2f659edca4ec8148e6": "03679d6ad1a4de8ee22b01b239b9c167376e447e916100529ce2b69e6dde1377",
    # plugins/backends/compiling.py: forgets executables, which are compiled again
    "27d56e4ba057fcb79d853751889cc30fda409b81bbc89020fe4cd3edc32f24fa": "4181f1e484759a64addabae4f926aed7167bbbb97d59b298236d4f7c2dbd30d6",
    # plugins/estimators/total_propagation.py: leaves out the numbers of a random start, which no stored scene has
    "993ab3f7c080de843a73361c06091c0a87e41a1614fba3f7a60b05942e3e8857": "03dfa4afb84aaf70b769fd9471f75081d552d3453ff8b965b69e49b686737d8b",
    # plugins/estimators/optimal_baseline.py: scores of exactly 0, and fewer than 4 samples with an explicit derivative, which no stored row has
    "c7009579857c0ea9cf6bd7393f77f445511793962446a5f5f9d4e318f80621c5": "234800ee6a37bcf126ad4e49938e8f4ef856051eb35db9da3c0d4cd7f9e7b529",
    # plugins/estimators/orthogonal.py: a declaration for the kit and for costs beyond the measured samples
    "6ca2892e2892dba1d0503ab1326d30a3a039625860e469b061abaedcc615d321": "b202cefabee9b310285d340bc4859d20d64816f497bdb3f594a3c7d544537255",
    # plugins/scenes/cartpole_swing.py: imports from the public names
    "45d784282200121fe5ae6ecaaa166982a3a954568bc057f953aaf9a400a28f7b": "ff27737fdc555092e07c9f70f2a93164b7ec250445e3efc42278a093373d3f6c",
    # plugins/policies/linear.py: imports from the public names
    "26bc2dc370a8bbfb34e2c59db3fc7bb53d236dceb31c8f1384a0952a0bfae12d": "b186ee7bb2b0a68808573a8e9a9d5662031dbd8ee5a9a8892345afd57fb98207",
    # bench/studies/identify/measure.py: scans of the loss, and windows of first-order scenes that start at the measurements, which no stored row has
    "b33d60a4c966cc89cf9252f7208ac6baf0c3f5a610e1bcd5b55f76a4b1a62d32": "d6b0adf289c73e9f1242412c760ffac520af75030cdc93cd8a9f8d2ff6fca860",
    # bench/training/evaluation.py: scenes without a random start, which no stored row has
    "4e4e92ad12ad459268276452de9d92447609b50b51f136a670a8894f55dcde11": "fee1e09006427e51ebe8172ecbdc8ac76366922b7225e35c26a1993d121e599c",
    # bench/training/fitting.py: refuses more batches than states, which no stored row has
    "4ccf81bc6d7e8b7c66e350f09cbade82b42523e1933928d90fe9e0a773edf604": "c09fb2d21730de2566b1607dd2f5cf30cc0f2f9a6a97f395b798f3378a996fe0",
    # bench/engines/problem.py: asks the program whether its law is open-loop, an engine's settings for the row, and weights of costs, which are 1 in all stored rows
    "c94419a9b2fa32631f0db9a20d4b0c39d150bb16ec710abf69f803b1089e5398": "48ac5bce93078bdac75ea14151589c5fb68141cf5ddd768e00982181f06b8495",
    # bench/model/optimizer.py: answers have a field that no stored row uses
    "3eade79e9325d352ff0765c87f98a09ab2b8bd083fbf5d237cb869655811b6d5": "6f4d0e199929423d63585facc347881eeffde26603a3145be3d59d374a71cc60",
    # bench/studies/optimise/batched.py: step Jacobians by differences where searches share batches, and a cell without an experiment around it, which both failed
    "95b5511339c7cdb6d5d86c0c32c5ce6bef7de8e060a2eb7663b9e8ea692debc0": "4f49be415809ba937cd8db1056cbe6ee1b4ca684c4f42cde87983c56c63e7a4d",
    # bench/studies/optimise/search.py: fills a field of answers that no stored row uses; step Jacobians by differences where noise is scaled, which failed
    "e78b1dcc70a454c583c12c4a412a51fbc96d7a23fe913f6a56c69a7ab665d865": "66478ff8c2b408f300e8ab86de52a3df1d6d1051174815a474226d0899387abe",
    # the class of bench/studies/optimise/__init__.py: refuses what no stored row uses
    "da6a2b11bbeaec7bf6c9aa0a063f4add0835b4cc691d9e4c6b83704c26191c32": "fea6cd6d956324bdbb44b35de8201df8b71c45ad683e76e6c767657dae6cb62f",
    # the class of bench/studies/identify/__init__.py: refuses an optimizer that no stored row has
    "7708dadb06abe2e733e4dd7c0601193cda5a08a6ec88403e333a4ff574b585b0": "5145bf1bccd6c12f885cda3572cab4b5252ad9489bc13409b54dae2b165eb14d",
    # bench/measure/contacts.py: the contacts that an engine reports, which no stored row has
    "e3b2615ea6b0d83015e84a0eee2bab51fbe9c5a4f32fb20648ecf1fb0448eaba": "8c3394de2fc039661d7c5950c75bad263cf80a8bc7e3dcf4740d978438af1e67",
    # bench/studies/gradient_check/measure.py: the contacts that an engine reports, and names of contact switches, which decide no number of a stored row
    "c2e7455a4cdf5dcd6425e42260e6d4ab7d2d5b10c364b79b66579ddaebe7f747": "03778fb4f46929c215ca6edd20560649d5f6ee282b739277d1e4804127712e51",
    # plugins/backends/newton.py: further solvers, which no stored row has
    "06cfc646591fe242ec9400a4a4d4ede724ae70d6048f0f460bb2989056e1d6ba": "64df3841b2e4db4d7a0757bd8d9c2b81434c43b04f25b6588ca77cd10286eb99",
    # plugins/engines/newton.py: further solvers, which no stored row has, and its settings for the row
    "85a197dd224966ccf3faf36d1e9d45e382f8eea58bf9e54d9a2652d29a864e76": "39d955ef59f7db0ae6018390c235e35f54ce33fe319a977ab24f9cd5b7b02a0a",
    # plugins/engines/mujoco_warp.py: its settings for the row
    "d4a60d30eadbf659aa896206e48fd0992bc3664be956e8b1a68ff1386898c0d6": "ae7cf60ca2bb31ff44f49ac80efabe621f833ec5564e04074c508338eac1c19e",
    # bench/engines/server.py: an engine's settings for the row
    "3f58a0cafa88e53d66ef3bf68f0e216cf87dd0bc3cd3641445dd8a7fe5de3156": "873da910c2050a965b4df6f85a6a055e1b4351ad8c23649263608a68e9ae2cf9",
    # bench/engines/backend.py: a declaration for the kit
    "6149abe5f46587b3d8eb8f470e37bdce77c01374e361aab5999d084ae18a276d": "76a879a70ed24fc4311af996e4bb5f593c109c0f65d4214ffd54f7073c02f695",
    # bench/studies/engines/measure.py: device and settings of the engine for the row
    "d5e3901c746d9f377a69747b31e0164647a326cb0e6f97f86045a2fa2832e07e": "46d42f6782eabcab65ff6473c1eacca1641a5345b5388a93bc429743b02174fd",
    # bench/measure/gradcheck/sampling.py: calls may differ in their last digits, as no stored row's do
    "125fdea2e0627bb5099d28e792220cbf54827953ddcfedc82e6bd59984763f25": "bb6236b81dbeaf081607d32f4a1811a5f525b89a60406f69babb3123cb2bd12a",
    # bench/measure/gradcheck/check.py: calls may differ in their last digits, as no stored row's do
    "68ff709898b81a8338d9c6b5a7a9dffa958a5f79fe387b1d35163d59c8329710": "022e3f0543d013eba1fdcd4af5c8eaa83d6e118c9e76b19b822e78bcd7a551b0",
    # bench/measure/gradcheck/__init__.py: one more name
    "393f225cbaafb140fb5e64053a0d8756db2de946bc0aa4ab264483b416b31692": "f965dfe680d35ea51da514344bfdf1e2a7728d16485d4c8d967fee9fd5fe25e9",
    # bench/model/policy.py: controls of a trained network's actions, which are the actions in all stored rows, a discount and normalised observations, which none has
    "6c2237498d83324baabe9126743299301e6ff2d50682e6014ba81f9dcc3c19ba": "c7bd75c4ea4fa863abffd86725712f9e9798a0f8a5b7c41c2c52b43c890e1c58",
    # bench/training/environment.py: controls of a trained network's actions, which are the actions in all stored rows; refuses a discounted scene
    "b3e11f0d56d0ed05202d2c6352006fd153ad41b58be8690506f8b44d244c41b8": "6aa866f73c01dfeda2b1d4c2a289a10da52f29ab8768c4a76018c39488fa779b",
    # bench/training/windows.py: controls of a trained network's actions, which are the actions in all stored rows
    "42acbd247be5e409f9f5b031ccce299de23779a8d881cde645985148c3b2b05c": "b32815416608beb1d442f5a7fb2d50ee6443130c23b9f3dd3cfc7056935083f5",
    # bench/studies/train/measure.py: trains on the program that a backend runs, which is the scene's own in all stored rows
    "9b1e924cb067200642a908d1017565baa94d7576dc1bfce79cc9f01614140c4e": "dff6e39f186adc16bad4f8cb9475359cce455caee025705db5a25b219b479c4a",
    # plugins/scenes/mjcf.py: controls of a trained network's actions, which no stored row has
    "40f5a560fa0e9fb3cea4708ff14d1a00aad69004bd9e49d4705131ded8a3da14": "f302f032f1e6e1b031801f5896df99bc0f3f8a962349db73ed6aeec772b7945c",
    # plugins/trainers/evolution.py: shares its episodes with another trainer
    "686532575ae796c4217d1d3d7d95c9b0f48ca9dbc3792a9b6dd451d0f65968bc": "604abd01749d1f0cf4c1bc84d6045238660ab504dacb683d96a39c67f8465455",
    # plugins/estimators/planted.py: the best gradient of a scene with noise of its own, which no stored row has
    "655a3572e2bbe74f4735ea7edf4e8ee2d898fc78779967c6d0da15fe8b341410": "e9e0cd36e6596cd749d22fa2823919c2c7ea91c732d37d2e4486f36f769021e8",
    # bench/studies/dose_response/ground.py: the objective of a scene with noise of its own, which no stored row has
    "6b662592f6120ac2b8e79765e2788ff79f3a87c4580ab8cb37bea9fef91a5829": "b4c6f2bd35d60a5908e9e38ac4d0d9adf001763508ae271a68e5860a738d5e56",
    # plugins/scenes/heaviside.py: declares its event, which no stored row uses
    "ce37ea8f704c52f80bdf9637ce2855b40b905e23de7825d8247dc52578c7cc7d": "62b7d378b702a48097b07a0eef7f6aac386d34c77b3028567ec40bdf3f8a570f",
    # bench/trace/adjoints.py: weights of the costs of steps, which are 1 in all stored rows
    "8522ae5d2430fbced6b3a1e94e71355666ba5c1210db6d848540337568e41e5e": "7f592afa67aed65e145b0f972cdb2aafc18195565bb85fa4165aee3a8062ade9",
    # bench/studies/bias_variance/estimates.py: terms of a long theta in parts, longer than in any stored row
    "e4cd5183e4b678285e2c220414839d6f1996bc535c0554a643390c5dd2f6ccc8": "b1c11c1e927407e7722da3471963a7ae79001c2a87e3f68b85f9c41d0babec2f",
    # bench/measure/statistics.py: an error without direction of more coordinates than any stored row has
    "51eb9c71012394bd872b8766ae81ec9445a2a30a43ea72d6335f036d5d833be6": "84ee3b297525a5a62f906f72c889b8c3ffb5ef0c706ed14afb9b5ea6e87f076b",
    # bench/measure/jumps.py: points of more coordinates than any stored row has, in parts
    "a6d5fb77ee965172f6c23ef8366258357121b9ecb632f2cce341b6e1ef95e677": "c9c777360e1c496fe08a44906155a28cb871bfabd77c62b774ce233a4a9ff5dd",
}
"""Hashes of files, and of classes of studies, whose changes decide no stored number: the new hash, and the one in the keys of rows.

Each change only adds something that no stored row uses, or moves the same operations. ``tests/experiment/test_equivalent.py`` runs stored cells again.
"""


def code_of(modules: Iterable[str], harmless: Collection[str] = ()) -> dict[str, Path]:
    """Return the files of modules and of all their imports from their own package and from bench, by module name.

    Modules in or below ``harmless`` are excluded, with the modules that only they import. Imports for type checking are
    ignored. If a package only re-exports a name, ``from package import name`` counts as an import of the defining
    module.
    """
    paths: dict[str, Path] = {}
    waiting = list(modules)
    while waiting:
        name = waiting.pop()
        path = None if name in paths or is_below(name, harmless) else file_of(name)
        if path is not None:
            paths[name] = path
            waiting.extend(imports(name))
    return paths


def is_below(module: str, packages: Iterable[str]) -> bool:
    """Return whether a module is one of the packages or lies inside one of them.

    >>> is_below("bench.report.tables", ["bench.report"]), is_below("bench.reports", ["bench.report"])
    (True, False)
    """
    return any(module == package or module.startswith(f"{package}.") for package in packages)


def hash_of(paths: Iterable[Path]) -> str:
    """Return one hash of the code in all files, ignoring file names, docstrings and comments."""
    digest = hashlib.sha256()
    for code in sorted(code_hash(path) for path in paths):
        digest.update(code.encode())
    return digest.hexdigest()


@remember
def code_hash(path: Path) -> str:
    """Return the hash of a file's syntax tree without docstrings, so that a reworded docstring reruns no cell.

    A file in :data:`EQUIVALENT` has the hash of its earlier version.
    """
    return stored_hash(ast.parse(path.read_bytes()))


def stored_hash(tree: ast.Module) -> str:
    """Return the hash of a syntax tree, or of its earlier version if :data:`EQUIVALENT` has one."""
    own = hash_of_tree(tree)
    return EQUIVALENT.get(own, own)


def hash_of_tree(tree: ast.Module) -> str:
    """Return the hash of a syntax tree without docstrings. Removes the docstrings from ``tree``."""
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            # a body with only a docstring becomes `pass`, so that it equals a body written as `pass`
            code = [part for part in body if not _is_text(part)]
            node.body = code or [ast.Pass()]  # type: ignore[attr-defined]
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()


def _is_text(node: ast.stmt) -> bool:
    """Return whether a statement is only a string: a docstring, or the docstring of an attribute."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


@cache
def imports(module: str) -> tuple[str, ...]:
    """Return the modules that a module imports, at its top or inside functions, from its own package and from bench."""
    path = file_of(module)
    return () if path is None else tuple(imports_of_tree(ast.parse(path.read_bytes()), module, path))


def imports_of_tree(tree: ast.AST, module: str, path: Path) -> Iterator[str]:
    """Yield the modules that a syntax tree, or a part of it, imports from the module's own package and from bench."""
    packages = {module.partition(".")[0], "bench"}
    parent = module if path.name == "__init__.py" else module.rpartition(".")[0]
    for node in _run_time_nodes(tree):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = importlib.util.resolve_name("." * node.level + (node.module or ""), parent)
            names = [origin for alias in node.names for origin in _origins(base, alias.name)]
        yield from (name for name in names if name.partition(".")[0] in packages and name != module)


def _run_time_nodes(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the nodes of a tree except those under ``if TYPE_CHECKING``."""
    if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
        return
    yield node
    for child in ast.iter_child_nodes(node):
        yield from _run_time_nodes(child)


def _origins(base: str, name: str) -> list[str]:
    """Return the modules that ``from base import name`` depends on."""
    if file_of(f"{base}.{name}") is not None:
        return [f"{base}.{name}"]
    return _passed_on(base).get(name, [base]) if _is_package(base) else [base]


def _is_package(module: str) -> bool:
    path = file_of(module)
    return path is not None and path.name == "__init__.py"


@cache
def _passed_on(package: str) -> dict[str, list[str]]:
    """Return the names that a package's ``__init__`` re-exports, each with the modules that define it."""
    path = file_of(package)
    assert path is not None
    names: dict[str, list[str]] = {}
    for node in ast.parse(path.read_bytes()).body:
        if isinstance(node, ast.ImportFrom):
            base = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
            for alias in node.names:
                if alias.name == "*":
                    names |= _passed_on(base) if _is_package(base) else {}
                elif base != package:
                    names[alias.asname or alias.name] = _origins(base, alias.name)
    return names


@remember
def file_of(module: str) -> Path | None:
    """Return the Python file of a module, or None if it has none."""
    parent = module.rpartition(".")[0]
    try:
        if parent and parent not in sys.modules:
            path = file_of(parent)
            if path is None or path.name != "__init__.py":
                return None
            spec = importlib.machinery.PathFinder.find_spec(module, [str(path.parent)])
        elif parent and not hasattr(sys.modules[parent], "__path__"):
            return None
        else:
            spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        return None
    origin = spec.origin if spec is not None else None
    return Path(origin) if origin is not None and origin.endswith(".py") else None
