// A CUDA device for torch that is host memory: tensors on cuda:0 live in the memory of the process, and every operation
// on them runs as the CPU's operation of the same name on the same memory.
//
// What a GPU refuses is refused here, too: tensors of two devices in one operation, infinity norms of empty lists, and,
// during a capture, whatever waits for the device or copies from or to pageable memory. Each contact of the host with
// the device is reported to a Python function (`pretended_set_reports`).
//
// A graph is a list of operations with the memory and the numbers that they had during the capture. A replay runs
// that list; no Python of the captured body runs again, except for launches that the recorder marked.
#include <ATen/CPUGeneratorImpl.h>
#include <ATen/EmptyTensor.h>
#include <ATen/core/dispatch/Dispatcher.h>
#include <ATen/detail/CUDAHooksInterface.h>
#include <ATen/ops/_local_scalar_dense.h>
#include <c10/core/impl/DeviceGuardImplInterface.h>
#include <torch/library.h>

#include <atomic>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <mutex>
#include <set>
#include <string>
#include <unordered_set>
#include <vector>

using at::Tensor;
using c10::IValue;
using torch::jit::Stack;

// MKL, which torch_cpu contains in most builds for x86.
extern "C" int MKL_Set_Num_Threads_Local(int) __attribute__((weak));

namespace {

constexpr c10::DeviceType CUDA = c10::DeviceType::CUDA;
const c10::Device DEVICE(CUDA, 0);

// On a GPU a product's rounding does not depend on the number of threads of the host. MKL's does on processors of other
// makers than Intel, where it ignores MKL_CBWR's STRICT; so operations of this device are given one of its threads.
class OneThreadOfMkl {
public:
    OneThreadOfMkl() {
        if (MKL_Set_Num_Threads_Local) before = MKL_Set_Num_Threads_Local(1);
    }
    ~OneThreadOfMkl() {
        if (MKL_Set_Num_Threads_Local) MKL_Set_Num_Threads_Local(before);
    }

private:
    int before = 0;
};

// ---- Reports

enum Kind : int { OPERATION = 0, CONTACT = 1 };
using Report = void (*)(int kind, const char* name);
std::atomic<Report> report{nullptr};

struct Entry {
    // An operation with its arguments, or the number of a call that Python repeats.
    std::optional<c10::OperatorHandle> operation;
    Stack arguments;
    std::vector<Tensor> results;  // on the host; undefined where the operation returned one of its arguments
    int call = -1;
};
struct Graph {
    std::vector<Entry> entries;
};
std::atomic<Graph*> captured{nullptr};

void tell(Kind kind, const char* name) {
    if (kind == CONTACT)
        TORCH_CHECK(
            captured.load() == nullptr, "CUDA error: operation not permitted when stream is capturing (", name, ")");
    if (Report call = report.load()) call(kind, name);
}

// ---- Memory

std::atomic<long> allocated{0}, most{0};

struct Block {
    void* data;
    size_t size;
};

void free_block(void* at) {
    auto* block = static_cast<Block*>(at);
    allocated -= static_cast<long>(block->size);
    std::free(block->data);
    delete block;
}

struct DeviceAllocator final : c10::Allocator {
    c10::DataPtr allocate(size_t size) override {
        void* data = nullptr;
        if (size > 0) TORCH_CHECK(posix_memalign(&data, 512, size) == 0, "CUDA out of memory (pretended)");
        // Nobody may rely on new memory being zero: it is not, on a GPU.
        if (data) std::memset(data, 0xff, size);
        const long now = allocated += static_cast<long>(size);
        for (long before = most; now > before && !most.compare_exchange_weak(before, now);) {}
        return {data, new Block{data, size}, &free_block, DEVICE};
    }
    c10::DeleterFnPtr raw_deleter() const override { return nullptr; }
    void copy_data(void* to, const void* from, size_t size) const override { std::memcpy(to, from, size); }
};
DeviceAllocator device_allocator;

std::mutex pinned_lock;
std::set<void*> pinned;

void free_pinned(void* at) {
    {
        std::lock_guard<std::mutex> hold(pinned_lock);
        pinned.erase(at);
    }
    std::free(at);
}

struct PinnedAllocator final : c10::Allocator {
    c10::DataPtr allocate(size_t size) override {
        void* data = nullptr;
        TORCH_CHECK(posix_memalign(&data, 512, size ? size : 1) == 0, "no pinned memory");
        std::lock_guard<std::mutex> hold(pinned_lock);
        pinned.insert(data);
        return {data, data, &free_pinned, c10::Device(c10::DeviceType::CPU)};
    }
    c10::DeleterFnPtr raw_deleter() const override { return &free_pinned; }
    void copy_data(void* to, const void* from, size_t size) const override { std::memcpy(to, from, size); }
};
PinnedAllocator pinned_allocator;

bool is_pinned(const Tensor& tensor) {
    std::lock_guard<std::mutex> hold(pinned_lock);
    return tensor.has_storage() && pinned.count(const_cast<void*>(tensor.storage().data())) > 0;
}

// ---- One memory, two devices

// Two functions, because the deleter says whose storage it is: the device's, of which the host holds a view, or the
// host's, in which the device holds a result.
void release_storage(void* at) { delete static_cast<c10::Storage*>(at); }
void release_host_storage(void* at) { delete static_cast<c10::Storage*>(at); }

Tensor with_storage(c10::Storage storage, const Tensor& like, c10::DispatchKey key) {
    auto made = at::detail::make_tensor<c10::TensorImpl>(std::move(storage), c10::DispatchKeySet(key), like.dtype());
    made.unsafeGetTensorImpl()->set_sizes_and_strides(like.sizes(), like.strides(), like.storage_offset());
    return made;
}

// The same elements as a tensor on the CPU, which keeps the device's storage alive.
Tensor host(const Tensor& tensor) {
    if (!tensor.defined() || tensor.device().type() != CUDA) return tensor;
    const c10::Storage& storage = tensor.storage();
    c10::DataPtr data(
        const_cast<void*>(storage.data()), new c10::Storage(storage), &release_storage, c10::Device(c10::DeviceType::CPU));
    c10::Storage own(
        c10::Storage::use_byte_size_t(), storage.nbytes(), std::move(data), c10::GetAllocator(c10::DeviceType::CPU), true);
    return with_storage(std::move(own), tensor, c10::DispatchKey::CPU);
}

// A result of the CPU as a tensor on the device: in the storage that it is a view of, or in its own.
Tensor device(const Tensor& tensor) {
    if (!tensor.defined() || tensor.device().type() == CUDA) return tensor;
    const c10::DataPtr& data = tensor.storage().data_ptr();
    if (data.get_deleter() == &release_storage)
        return with_storage(*static_cast<c10::Storage*>(data.get_context()), tensor, c10::DispatchKey::CUDA);
    const size_t size = tensor.storage().nbytes();
    c10::DataPtr own(
        const_cast<void*>(data.get()), new c10::Storage(tensor.storage()), &release_host_storage, DEVICE);
    c10::Storage storage(c10::Storage::use_byte_size_t(), size, std::move(own), &device_allocator, true);
    return with_storage(std::move(storage), tensor, c10::DispatchKey::CUDA);
}

// Give the tensor on the device the shape and the memory of its form on the host, which an operation has resized.
void follow(const Tensor& tensor, const Tensor& on_host) {
    auto* impl = tensor.unsafeGetTensorImpl();
    if (on_host.storage().data() != tensor.storage().data()) {
        auto* storage = tensor.storage().unsafeGetStorageImpl();
        const size_t size = on_host.storage().nbytes();
        storage->set_data_ptr_noswap(c10::DataPtr(
            const_cast<void*>(on_host.storage().data()), new c10::Storage(on_host.storage()), &release_host_storage,
            DEVICE));
        storage->set_nbytes(size);
    }
    if (on_host.sizes() != tensor.sizes() || on_host.strides() != tensor.strides())
        impl->set_sizes_and_strides(on_host.sizes(), on_host.strides(), on_host.storage_offset());
}

// ---- Any operation

const std::unordered_set<std::string> WAITING = {
    "aten::nonzero",   "aten::masked_select", "aten::_unique2",  "aten::unique_dim",
    "aten::equal",     "aten::bincount",      "aten::histc",     "aten::repeat_interleave",
    "aten::multinomial", "aten::unique_consecutive", "aten::_local_scalar_dense",
};
const std::unordered_set<std::string> INDEXING = {
    "aten::index", "aten::index_put_", "aten::index_put", "aten::_index_put_impl_", "aten::_unsafe_index"};

struct Seen {
    bool device = false, mask = false, host_index = false;
    const Tensor* stranger = nullptr;  // a tensor on the CPU that is not a number
};

void see(const Tensor& tensor, bool index, Seen& seen) {
    if (!tensor.defined()) return;
    if (tensor.device().type() == CUDA) {
        seen.device = true;
        seen.mask |= index && (tensor.scalar_type() == at::kBool || tensor.scalar_type() == at::kByte);
    } else if (tensor.dim() > 0) {
        if (index) seen.host_index = true;
        else seen.stranger = &tensor;
    }
}

template <typename Change> void each_tensor(IValue& value, Change change) {
    if (value.isTensor()) {
        value = change(value.toTensor());
    } else if (value.isTensorList()) {
        std::vector<Tensor> list = value.toTensorVector();
        for (Tensor& item : list) item = change(item);
        value = c10::List<Tensor>(list);
    } else if (value.isOptionalTensorList()) {
        c10::List<std::optional<Tensor>> list;
        for (std::optional<Tensor> item : value.toOptionalTensorList())
            list.push_back(item ? std::optional<Tensor>(change(*item)) : item);
        value = list;
    } else if (value.isList()) {
        auto list = value.toList();
        if (list.elementType()->isSubtypeOf(*c10::OptionalType::create(c10::TensorType::get())))
            for (size_t at = 0; at < list.size(); ++at) {
                IValue item = list.get(at);
                if (item.isTensor()) list.set(at, change(item.toTensor()));
            }
    }
}

std::mutex generators_lock;
std::set<const c10::GeneratorImpl*> generators;  // those made for the device; they live as long as the process

void refuse(const std::string& name, const Seen& seen, const Stack& arguments) {
    for (const IValue& argument : arguments) {
        if (!argument.isGenerator()) continue;
        std::lock_guard<std::mutex> hold(generators_lock);
        TORCH_CHECK(
            generators.count(argument.toGenerator().unsafeGetGeneratorImpl()) > 0,
            "Expected a 'cuda' device type for generator but found 'cpu' (", name, ")");
    }
    TORCH_CHECK(
        !(seen.device && seen.stranger),
        "Expected all tensors to be on the same device, but found at least two devices, cuda:0 and cpu! (", name, ")");
    if (name == "aten::_foreach_norm" && arguments.size() > 1 && arguments[1].isDouble() &&
        std::isinf(arguments[1].toDouble()))
        for (const Tensor& item : arguments[0].toTensorVector())
            TORCH_CHECK(
                item.numel() > 0,
                "_foreach_norm cannot compute the infinity norm on an empty tensor because the operation does not "
                "have an identity");
    if (WAITING.count(name)) tell(CONTACT, name.c_str() + 6);
    if (seen.mask) tell(CONTACT, "index with a mask");
    if (seen.host_index) tell(CONTACT, "index from the host");
}

void run(const c10::OperatorHandle& operation, Stack* stack) {
    const auto& schema = operation.schema();
    const std::string name = schema.name();
    const size_t count = schema.arguments().size(), begin = stack->size() - count;
    const bool indexing = INDEXING.count(name) > 0;
    Stack given(stack->begin() + begin, stack->end());
    Seen seen;
    for (size_t at = 0; at < count; ++at) {
        const bool index = indexing && at == 1;
        IValue copy = given[at];
        each_tensor(copy, [&](const Tensor& tensor) { return see(tensor, index, seen), tensor; });
        if (given[at].isDevice() && given[at].toDevice().type() == CUDA) seen.device = true;
    }
    refuse(name, seen, given);
    tell(OPERATION, name.c_str() + (name.rfind("aten::", 0) == 0 ? 6 : 0));
    Stack on_host;
    for (size_t at = 0; at < count; ++at) {
        IValue value = given[at];
        each_tensor(value, host);
        if (value.isDevice() && value.toDevice().type() == CUDA) value = c10::Device(c10::DeviceType::CPU);
        on_host.push_back(std::move(value));
    }
    Graph* graph = captured.load();
    Entry entry;
    if (graph) entry = {operation, on_host, {}, -1};
    const Stack before = on_host;
    stack->resize(begin);
    {
        const OneThreadOfMkl one;
        operation.callBoxed(&on_host);
    }
    for (size_t at = 0; at < count; ++at) {
        const auto* alias = schema.arguments()[at].alias_info();
        if (alias && alias->isWrite() && given[at].isTensor() && given[at].toTensor().defined() &&
            given[at].toTensor().device().type() == CUDA)
            follow(given[at].toTensor(), before[at].toTensor());
    }
    for (size_t at = 0; at < on_host.size(); ++at) {
        const auto* alias = schema.returns()[at].alias_info();
        IValue result = on_host[at];
        if (alias && alias->isWrite()) {
            for (size_t from = 0; from < count; ++from) {
                const auto* of = schema.arguments()[from].alias_info();
                if (of && of->isWrite() && of->beforeSets() == alias->beforeSets()) {
                    result = given[from];
                    break;
                }
            }
        } else {
            each_tensor(result, [&](const Tensor& tensor) {
                if (graph && tensor.defined()) entry.results.push_back(tensor);
                return device(tensor);
            });
        }
        stack->push_back(std::move(result));
    }
    if (graph) graph->entries.push_back(std::move(entry));
}

void fallback(const c10::OperatorHandle& operation, c10::DispatchKeySet, Stack* stack) { run(operation, stack); }

void replay(const Graph& graph, void (*call)(int)) {
    const OneThreadOfMkl one;
    for (const Entry& entry : graph.entries) {
        if (!entry.operation) {
            call(entry.call);
            continue;
        }
        Stack stack = entry.arguments;
        entry.operation->callBoxed(&stack);
        size_t at = 0;
        const auto& returns = entry.operation->schema().returns();
        for (size_t index = 0; index < stack.size(); ++index) {
            const auto* alias = returns[index].alias_info();
            if (alias && alias->isWrite()) continue;
            each_tensor(stack[index], [&](const Tensor& tensor) {
                if (tensor.defined()) {
                    const Tensor& recorded = entry.results.at(at++);
                    if (tensor.storage().data() != recorded.storage().data()) recorded.copy_(tensor);
                }
                return tensor;
            });
        }
    }
}

// ---- Operations that allocate, copy or resize

Tensor empty(
    at::IntArrayRef size, std::optional<at::ScalarType> dtype, std::optional<at::Layout>, std::optional<at::Device>,
    std::optional<bool>, std::optional<at::MemoryFormat> format) {
    tell(OPERATION, "empty");
    return at::detail::empty_generic(
        size, &device_allocator, c10::DispatchKeySet(c10::DispatchKey::CUDA), c10::dtype_or_default(dtype), format);
}

Tensor empty_strided(
    at::IntArrayRef size, at::IntArrayRef stride, std::optional<at::ScalarType> dtype, std::optional<at::Layout>,
    std::optional<at::Device>, std::optional<bool>) {
    tell(OPERATION, "empty");
    return at::detail::empty_strided_generic(
        size, stride, &device_allocator, c10::DispatchKeySet(c10::DispatchKey::CUDA), c10::dtype_or_default(dtype));
}

Tensor& copy_(Tensor& to, const Tensor& from, bool non_blocking) {
    const bool crosses = to.device() != from.device() && from.numel() > 0;
    if (crosses) {
        const bool in = to.device().type() == CUDA;
        const bool waits = !non_blocking || !is_pinned(in ? from : to);
        if (waits) tell(CONTACT, in ? "copy from the host" : "copy to the host");
    }
    tell(OPERATION, "copy_");
    const auto operation = c10::Dispatcher::singleton().findSchemaOrThrow("aten::copy_", "");
    Stack stack{host(to), host(from), non_blocking};
    if (Graph* graph = captured.load()) graph->entries.push_back({operation, stack, {}, -1});
    operation.callBoxed(&stack);
    return to;
}

const Tensor& resize_(const Tensor& self, at::IntArrayRef size, std::optional<at::MemoryFormat>) {
    tell(OPERATION, "resize_");
    auto* impl = self.unsafeGetTensorImpl();
    int64_t count = 1;
    for (int64_t length : size) count *= length;
    const size_t needed = (static_cast<size_t>(count) + self.storage_offset()) * self.itemsize();
    if (needed > self.storage().nbytes()) {
        c10::DataPtr larger = device_allocator.allocate(needed);
        std::memcpy(larger.get(), self.storage().data(), self.storage().nbytes());
        auto* storage = self.storage().unsafeGetStorageImpl();
        storage->set_data_ptr_noswap(std::move(larger));
        storage->set_nbytes(needed);
    }
    impl->set_sizes_contiguous(size);
    return self;
}

Tensor& set_storage(
    Tensor& self, at::Storage source, int64_t offset, at::IntArrayRef size, at::IntArrayRef stride) {
    auto* impl = self.unsafeGetTensorImpl();
    impl->set_storage_keep_dtype(std::move(source));
    if (stride.size() == size.size() && !size.empty()) impl->set_sizes_and_strides(size, stride, offset);
    else {
        impl->set_sizes_contiguous(size);
        impl->set_storage_offset(offset);
    }
    return self;
}

Tensor& set_whole_storage(Tensor& self, at::Storage source) {
    const int64_t length = static_cast<int64_t>(source.nbytes() / self.itemsize());
    return set_storage(self, std::move(source), 0, {length}, {1});
}

// ---- What torch asks of a device

at::Generator make_generator() {
    static auto* kept = new std::vector<at::Generator>;
    at::Generator made = at::make_generator<at::CPUGeneratorImpl>(c10::detail::getNonDeterministicRandom());
    std::lock_guard<std::mutex> hold(generators_lock);
    generators.insert(made.unsafeGetGeneratorImpl());
    kept->push_back(made);
    return made;
}

struct Hooks final : at::CUDAHooksInterface {
    explicit Hooks(at::CUDAHooksArgs) {}
    const at::Generator& getDefaultGenerator(c10::DeviceIndex) const override {
        static const at::Generator own = make_generator();
        return own;
    }
    at::Generator getNewGenerator(c10::DeviceIndex) const override { return make_generator(); }
    void init() const override {}
    bool hasCUDA() const override { return true; }
    bool isBuilt() const override { return true; }
    bool isAvailable() const override { return true; }
    bool hasPrimaryContext(c10::DeviceIndex) const override { return true; }
    c10::DeviceIndex deviceCount() const override { return 1; }
    int getNumGPUs() const override { return 1; }
    c10::DeviceIndex getCurrentDevice() const override { return 0; }
    c10::Allocator* getPinnedMemoryAllocator() const override { return &pinned_allocator; }
    c10::Allocator* getCUDADeviceAllocator() const override { return &device_allocator; }
    bool isPinnedPtr(const void* data) const override {
        std::lock_guard<std::mutex> hold(pinned_lock);
        return pinned.count(const_cast<void*>(data)) > 0;
    }
};

struct Guard final : c10::impl::DeviceGuardImplInterface {
    c10::DeviceType type() const override { return CUDA; }
    c10::Device exchangeDevice(c10::Device) const override { return DEVICE; }
    c10::Device getDevice() const override { return DEVICE; }
    void setDevice(c10::Device) const override {}
    void uncheckedSetDevice(c10::Device) const noexcept override {}
    c10::Stream getStream(c10::Device) const override { return c10::Stream(c10::Stream::DEFAULT, DEVICE); }
    c10::Stream getNewStream(c10::Device, int) const override { return c10::Stream(c10::Stream::DEFAULT, DEVICE); }
    c10::Stream exchangeStream(c10::Stream) const override { return c10::Stream(c10::Stream::DEFAULT, DEVICE); }
    c10::DeviceIndex deviceCount() const noexcept override { return 1; }
    void record(void**, const c10::Stream&, const c10::DeviceIndex, const c10::EventFlag) const override {}
    void block(void*, const c10::Stream&) const override {}
    bool queryEvent(void*) const override { return true; }
    void destroyEvent(void*, const c10::DeviceIndex) const noexcept override {}
    bool queryStream(const c10::Stream&) const override { return true; }
    void synchronizeStream(const c10::Stream&) const override {}
};
c10::impl::DeviceGuardImplRegistrar guard_registrar(CUDA, new Guard());

}  // namespace

namespace at {
using PretendedHooks = Hooks;
C10_REGISTER_TYPED_CLASS(CUDAHooksRegistry, "CUDAHooks", PretendedHooks)
}  // namespace at

TORCH_LIBRARY_IMPL(_, CUDA, library) { library.fallback(torch::CppFunction::makeFromBoxedFunction<&fallback>()); }

TORCH_LIBRARY_IMPL(aten, CUDA, library) {
    library.impl("empty.memory_format", &empty);
    library.impl("empty_strided", &empty_strided);
    library.impl("copy_", &copy_);
    library.impl("resize_", &resize_);
    library.impl("set_.source_Storage", &set_whole_storage);
    library.impl("set_.source_Storage_storage_offset", &set_storage);
    library.impl("_foreach_norm.Scalar", torch::CppFunction::makeFromBoxedFunction<&fallback>());
}

extern "C" {
void pretended_set_reports(Report call) { report = call; }
void pretended_contact(const char* name) { tell(CONTACT, name); }
long pretended_allocated() { return allocated; }
long pretended_most() { return most; }
void pretended_reset_most() { most = allocated.load(); }
void* pretended_graph_begin() {
    auto* graph = new Graph;
    Graph* none = nullptr;
    if (captured.compare_exchange_strong(none, graph)) return graph;
    delete graph;
    return nullptr;
}
void pretended_graph_call(int number) {
    if (Graph* graph = captured.load()) graph->entries.push_back({std::nullopt, {}, {}, number});
}
int pretended_capturing() { return captured.load() != nullptr; }
void pretended_graph_end() { captured = nullptr; }
long pretended_graph_size(void* graph) { return static_cast<long>(static_cast<Graph*>(graph)->entries.size()); }
// Returns 0, or 1 with the message of an error in `pretended_error`.
std::string last_error;
const char* pretended_error() { return last_error.c_str(); }
int pretended_graph_replay(void* graph, void (*call)(int)) {
    try {
        at::NoGradGuard no_grad;
        replay(*static_cast<Graph*>(graph), call);
        return 0;
    } catch (const std::exception& error) {
        last_error = error.what();
        return 1;
    }
}
void pretended_graph_free(void* graph) { delete static_cast<Graph*>(graph); }
}
