import subprocess
import sys

PROGRAM = """
import sys
import torch
from gamba_warp.kernels import causal_conv1d

x, weight = torch.randn(1, 7, 5), torch.randn(5, 4, requires_grad=True)
plain = causal_conv1d(x, weight)
plain.sum().backward()
assert "torch._dynamo" not in sys.modules, "the first call has imported torch's compiler"

def layer(x):
    return causal_conv1d(torch.sin(x), weight).cos()

eager = layer(x)
compiled = torch.compile(layer, fullgraph=True, backend="aot_eager")
assert torch.equal(compiled(x), eager)
# Once the compiler is there, it passes over the operator's body as for every operator of torch.
torch._dynamo.reset()
torch._dynamo.utils.counters.clear()
assert torch.equal(torch.compile(layer, backend="eager")(x), eager)
assert not torch._dynamo.utils.counters["graph_break"]
assert torch.equal(causal_conv1d(x, weight), plain)
print("done")
"""


def test_an_operator_loads_no_compiler_and_compiles_when_asked():
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.endswith("done\n"), done.stderr
